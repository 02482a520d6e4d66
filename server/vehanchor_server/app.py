"""The MCP server, independent of its transport."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import Any

from mcp.server import MCPServer
from mcp.server.apps import client_supports_apps
from mcp.server.auth.provider import TokenVerifier
from mcp.server.auth.settings import AuthSettings
from mcp.server.caching import CacheableMethod, CacheHint
from mcp.server.context import ServerRequestContext
from mcp.server.mcpserver import Context
from mcp.types import (
    CallToolResult,
    Icon,
    InputRequiredResult,
    ListToolsResult,
    PaginatedRequestParams,
)

from vehanchor_server.app_page.page import PAGE_ONLY_META, app_extension
from vehanchor_server.errors import shortened
from vehanchor_server.services import Services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools
from vehanchor_server.tools.strict_tool import ReportedError, StrictTool
from vehanchor_server.tools.view_image import page_image_tool

# Their answers change only with the server's version.
_CACHEABLE: tuple[CacheableMethod, ...] = ("tools/list", "resources/list", "resources/read")
_CACHE_TTL_MS = 3_600_000


def create_server(
    services: Services,
    *,
    auth: AuthSettings | None = None,
    token_verifier: TokenVerifier | None = None,
) -> MCPServer[object]:
    """Create the MCP server with all its tools.

    Args:
        services: shared parts of the tools.
        auth: authentication over HTTP; needs ``token_verifier``.
        token_verifier: verifies bearer tokens.
    """
    tools = create_tools(services)
    cache_hint = CacheHint(ttl_ms=_CACHE_TTL_MS, scope="public")
    return _Server(
        "vehanchor",
        title="VehAnchor",
        description="Metric scale, distances and areas from aerial images without metadata. "
        "Cars are the ruler.",
        instructions=_instructions(tools, services.resources.settings),
        version=version("vehanchor"),
        icons=[_icon()],
        tools=[*tools, page_image_tool(services)],
        extensions=[app_extension()],
        cache_hints=dict.fromkeys(_CACHEABLE, cache_hint),
        subscriptions=False,
        auth=auth,
        token_verifier=token_verifier,
    )


def _icon() -> Icon:
    """Return the server's icon as a ``data:`` address, so that hosts fetch nothing."""
    picture = files("vehanchor_server").joinpath("icon.png").read_bytes()
    source = f"data:image/png;base64,{base64.b64encode(picture).decode()}"
    return Icon(src=source, mime_type="image/png", sizes=["48x48"])


class _Server(MCPServer[object]):
    """The SDK's server with short errors for unknown tools.

    Only clients with pages see the page's tool.
    """

    async def _handle_list_tools(
        self, ctx: ServerRequestContext[Any, Any], params: PaginatedRequestParams | None
    ) -> ListToolsResult:
        """List the tools that the client can use."""
        listed = await super()._handle_list_tools(ctx, params)
        if not client_supports_apps(ctx):
            listed.tools = [tool for tool in listed.tools if tool.meta != PAGE_ONLY_META]
        return listed

    async def call_tool(
        self, name: str, arguments: dict[str, Any], context: Context[object, Any] | None = None
    ) -> CallToolResult | InputRequiredResult:
        """Call a tool.

        Raises:
            CallError: the call failed, or there is no such tool.
        """
        tools = self._tool_manager.list_tools()
        if name not in {tool.name for tool in tools}:
            listed = ", ".join(tool.name for tool in tools if tool.meta != PAGE_ONLY_META)
            message = f"there is no tool {shortened(name)!r}. Tools: {listed}."
            raise ReportedError("unknown_tool", message)
        return await super().call_tool(name, arguments, context)


def _instructions(tools: Sequence[StrictTool], settings: Settings) -> str:
    """Return the instructions for models: the tools, and the images that this server accepts."""
    kinds = []
    if settings.roots:
        kinds.append("path, below " + " or ".join(map(str, settings.roots)))
    kinds.append("base64 (from programs)")
    if settings.image_hosts:
        kinds.append("url, on " + " or ".join(settings.image_hosts))
    names = " ".join(f"{tool.title}: {tool.name}." for tool in tools)
    return (
        f"VehAnchor uses the cars in aerial images as a ruler. {names} "
        f"Act only on results with status ok. Images are accepted by {'; '.join(kinds)}."
    )
