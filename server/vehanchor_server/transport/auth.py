"""Authentication over HTTP: tokens from the operator's file, or JWTs from the operator's issuer."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import math
import os
import stat
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import TYPE_CHECKING, Any

import anyio
import httpx2 as httpx
import jwt
from mcp.server.auth.provider import AccessToken, TokenVerifier

from vehanchor_server.settings import Settings, SettingsError

if TYPE_CHECKING:
    from pathlib import Path

MIN_TOKEN_CHARS = 16  # shorter tokens can be guessed
KEYS_REFRESH_S = 3600.0  # age at which keys are fetched again, beside the calls
KEYS_RETRY_S = 30.0  # minimum interval between fetches, also for unknown keys and after a failure
FETCH_S = 5.0  # for both documents together
MAX_DOCUMENT_BYTES = 64 << 10
_ALGORITHMS = (
    "RS256",
    "RS384",
    "RS512",
    "PS256",
    "PS384",
    "PS512",
    "ES256",
    "ES384",
    "ES512",
    "EdDSA",
)
_LEEWAY_S = 30

_logger = logging.getLogger(__name__)


def token_verifier(settings: Settings) -> TokenVerifier | None:
    """Create the verifier of the settings; None if callers need no token.

    Raises:
        SettingsError: the token file is invalid.
    """
    if settings.token_file is not None:
        return StaticTokenVerifier(read_tokens(settings.token_file))
    if settings.oidc is not None:
        issuer, max_key_age_s = settings.issuer
        _, audience = settings.oidc
        return OidcVerifier(issuer, audience, max_key_age_s=max_key_age_s)
    return None


def read_tokens(path: Path) -> list[str]:
    """Read the tokens of a file, one per line; ignore blank lines and lines that begin with ``#``.

    Log a warning if every user can read the file.

    Raises:
        SettingsError: the file is unreadable, has no token, or has a short token.
    """
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
        is_readable_by_all = os.name == "posix" and path.stat().st_mode & stat.S_IROTH
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"token file {path} cannot be read: {error}") from None
    tokens = [line for line in lines if line and not line.startswith("#")]
    if not tokens:
        raise SettingsError(
            f"token file {path} has no token; write one with: openssl rand -hex 32 > {path}"
        )
    if any(len(token) < MIN_TOKEN_CHARS for token in tokens):
        raise SettingsError(
            f"token file {path}: a token is shorter than {MIN_TOKEN_CHARS} characters; use "
            "longer ones"
        )
    if is_readable_by_all:
        _logger.warning(
            "every user of this machine can read the token file %s: chmod o-rwx it", path
        )
    return tokens


class StaticTokenVerifier(TokenVerifier):
    """Verifier of known tokens with constant-time comparison.

    Args:
        tokens: the accepted tokens.
    """

    def __init__(self, tokens: Sequence[str]) -> None:
        self._digests = [_digest(token) for token in tokens]

    async def verify_token(self, token: str) -> AccessToken | None:
        """Return the access of a token, or None."""
        digest = _digest(token)
        # All comparisons are made, so that the time does not depend on which token it is.
        matches = [hmac.compare_digest(digest, accepted) for accepted in self._digests]
        if not any(matches):
            return None
        number = matches.index(True) + 1
        return AccessToken(token=token, client_id=f"token-{number}", scopes=[])


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


async def _get_json(url: str) -> dict[str, Any]:
    """Fetch a JSON object of limited size, without redirects or compression."""
    body = b""
    async with (
        httpx.AsyncClient(timeout=FETCH_S, follow_redirects=False) as client,
        client.stream("GET", url, headers={"Accept-Encoding": "identity"}) as answer,
    ):
        answer.raise_for_status()
        async for part in answer.aiter_raw():
            body += part
            if len(body) > MAX_DOCUMENT_BYTES:
                raise ValueError(f"a document of more than {MAX_DOCUMENT_BYTES} bytes")
    document = json.loads(body)
    if not isinstance(document, dict):
        raise ValueError("not a JSON object")
    return document


class OidcVerifier(TokenVerifier):
    """Verifier of JWTs that an OpenID Connect issuer signed for this server.

    A caller whose key is known never waits for the issuer. An unknown key makes its caller wait for
    a fetch, unless one runs or ran a moment ago.

    Args:
        issuer: the issuer's URL; ``/.well-known/openid-configuration`` below it has the address of
            the keys.
        audience: required member of ``aud``.
        max_key_age_s: seconds after which keys end if they cannot be fetched again.
        get_json: fetches a JSON document.
    """

    def __init__(
        self,
        issuer: str,
        audience: str,
        *,
        max_key_age_s: float,
        get_json: Callable[[str], Awaitable[dict[str, Any]]] = _get_json,
    ) -> None:
        self._issuer = issuer
        self._audience = audience
        self._max_key_age_s = max_key_age_s
        self._get_json = get_json
        self._keys: dict[str | None, jwt.PyJWK] = {}
        self._fetched_at = -math.inf  # of the last success
        self._tried_at = -math.inf  # of the last try
        self._fetch: asyncio.Task[None] | None = None

    async def verify_token(self, token: str) -> AccessToken | None:
        """Return the access of a token, or None; the log has the cause."""
        try:
            header = jwt.get_unverified_header(token)
            if header.get("alg") not in _ALGORITHMS:
                raise jwt.InvalidAlgorithmError(f"alg {header.get('alg')!r} is not accepted")
            key = await self._key(header.get("kid"))
            claims = jwt.decode(
                token,
                key,
                algorithms=[header["alg"]],
                audience=self._audience,
                issuer=self._issuer,
                leeway=_LEEWAY_S,
                options={"require": ["exp", "iss", "aud"]},
            )
            expires_at = int(claims["exp"]) + _LEEWAY_S
        except (jwt.PyJWTError, ValueError, TypeError, OverflowError) as error:
            _logger.info("bearer token refused: %s", type(error).__name__)
            return None
        return AccessToken(
            token=token, client_id=str(claims.get("sub")), scopes=[], expires_at=expires_at
        )

    async def _key(self, kid: str | None) -> jwt.PyJWK:
        """Return the issuer's key.

        Raises:
            jwt.InvalidKeyError: the issuer has no such key, or its keys ended.
        """
        now = time.monotonic()
        age_s = now - self._fetched_at
        if self._keys and age_s > self._max_key_age_s:
            _logger.warning(
                "the keys of %s ended %g s after their last fetch",
                self._issuer,
                self._max_key_age_s,
            )
            self._keys = {}
        is_known = kid in self._keys
        needs_fetch = not is_known or age_s > KEYS_REFRESH_S
        may_fetch = now - self._tried_at > KEYS_RETRY_S
        if needs_fetch and may_fetch:
            self._tried_at = now
            # A task of its own, which goes on if its caller hangs up.
            self._fetch = asyncio.create_task(self._fetch_keys())
            awaited = self._fetch
        elif self._keys:
            awaited = None
        else:
            # Without any key, every caller waits for the fetch that another one started.
            awaited = self._fetch
        if awaited is not None and not is_known:
            await asyncio.shield(awaited)
        if kid not in self._keys:
            raise jwt.InvalidKeyError("the issuer has no such key")
        return self._keys[kid]

    async def _fetch_keys(self) -> None:
        """Replace the keys by the issuer's present ones; after a failure, keep them."""
        address = self._issuer.rstrip("/") + "/.well-known/openid-configuration"
        try:
            with anyio.fail_after(FETCH_S):
                configuration = await self._get_json(address)
                if configuration.get("issuer") != self._issuer:
                    raise ValueError(f"the document belongs to {configuration.get('issuer')!r}")
                address = str(configuration["jwks_uri"])
                if not address.startswith("https://"):
                    raise ValueError("jwks_uri is not https")
                document = await self._get_json(address)
                keys = jwt.PyJWKSet.from_dict(document).keys
            self._keys = {key.key_id: key for key in keys if key.public_key_use in (None, "sig")}
            self._fetched_at = time.monotonic()
        except Exception as error:  # whatever the issuer sends
            _logger.error("the keys of %s cannot be fetched: %r", self._issuer, error)
