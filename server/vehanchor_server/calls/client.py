"""Client of a call: the subject of its token."""

from __future__ import annotations


def current_client() -> str:
    """Return the name of the client of this call; an empty string without a token, as on stdio."""
    from mcp.server.auth.middleware.auth_context import get_access_token

    token = get_access_token()
    return "" if token is None else token.client_id
