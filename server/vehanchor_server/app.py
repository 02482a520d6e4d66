"""The server, without a transport."""

from __future__ import annotations

import os
from importlib.metadata import version

from mcp.server import MCPServer
from mcp.server.auth.provider import TokenVerifier
from mcp.server.auth.settings import AuthSettings
from mcp.server.caching import CacheableMethod, CacheHint

from vehanchor_server.app_page import app_extension
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.sandbox import Sandbox
from vehanchor_server.images.source import ImageSources
from vehanchor_server.models import Models
from vehanchor_server.settings import Settings
from vehanchor_server.tools.capacity import Capacity
from vehanchor_server.tools.registry import POLICY, Services, tools

__all__ = ["create_server", "create_services"]

_MIB = 1 << 20
_FIXED: tuple[CacheableMethod, ...] = ("tools/list", "resources/list", "resources/read")
_LIST_TTL_MS = 3_600_000  # they change with the server's version only


def create_services(settings: Settings) -> Services:
    """What the tools of one server share."""
    max_bytes = round(settings.max_image_mb * _MIB)
    return Services(
        settings=settings,
        models=Models(settings),
        sources=ImageSources(
            sandbox=Sandbox(settings.roots),
            fetcher=Fetcher(settings.image_hosts, max_bytes, settings.fetch_timeout_s),
            max_bytes=max_bytes,
        ),
        capacity=Capacity(settings.max_concurrency or default_concurrency(), settings.deadline_s),
    )


def default_concurrency() -> int:
    """One call for each CPU, and two at least."""
    return max(2, os.cpu_count() or 1)


def create_server(
    services: Services, *, auth: AuthSettings | None = None, token_verifier: TokenVerifier | None = None
) -> MCPServer[object]:
    """The MCP server with all its tools.

    Args:
        services: what the tools work with.
        auth: how callers over HTTP show who they are; with ``token_verifier``.
        token_verifier: checks their tokens.
    """
    return MCPServer(
        "vehanchor",
        title="VehAnchor",
        description="Metric scale and areas from aerial images without metadata: cars as the ruler.",
        instructions=_instructions(services.settings),
        version=version("vehanchor"),
        tools=list(tools(services)),
        extensions=[app_extension()],
        cache_hints=dict.fromkeys(_FIXED, CacheHint(ttl_ms=_LIST_TTL_MS, scope="public")),
        subscriptions=False,
        auth=auth,
        token_verifier=token_verifier,
    )


def _instructions(settings: Settings) -> str:
    kinds = ["base64 (from programs)"]
    if settings.roots:
        kinds.insert(0, "path, below " + " or ".join(map(str, settings.roots)))
    if settings.image_hosts:
        kinds.append("url, on " + " or ".join(settings.image_hosts))
    return (
        "VehAnchor measures the metric scale of aerial images from the cars in them (estimate_gsd), and the area of "
        "objects in them (measure_area). "
        f"{POLICY} Images are accepted by {'; '.join(kinds)}."
    )
