"""The page for people on loopback: ``vehanchor view`` serves it to one browser, with the tools behind it.

No agent is needed, and nobody else gets in: the address holds a random token, the Host must be this address, and a
request that a page of another origin makes, whose Origin or Sec-Fetch-Site says so, is refused.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import secrets
import signal
import socket
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import anyio
import anyio.to_thread
import uvicorn
from mcp import Client
from mcp.client import advertise
from mcp.server.apps import APP_MIME_TYPE, EXTENSION_ID
from mcp.shared.exceptions import MCPError
from starlette.applications import Starlette
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, StreamingResponse
from starlette.routing import Route

from vehanchor_server.app import create_server
from vehanchor_server.app_page import view_html
from vehanchor_server.services import create_services

if TYPE_CHECKING:
    from collections.abc import Callable

    from mcp.types import CallToolResult
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Receive, Scope, Send

    from vehanchor_server.settings import Settings

_LOOPBACK = "127.0.0.1"
_TOKEN_BYTES = 24
_MAX_CALL_BYTES = 64 << 10  # the largest that means anything, a box for each of 16 objects, is far below
_MAX_DROPPED = 500  # photographs of one session, kept in a folder of its own until it ends
_SHUTDOWN_S = 2
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the token stays in this browser
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",  # the page itself says the rest
}


@dataclass(frozen=True)
class Address:
    """Where the page is.

    Attributes:
        port: on 127.0.0.1.
        token: its first folder, random.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(_TOKEN_BYTES))

    def url(self, photograph: Path | None = None) -> str:
        """The page's address, with a photograph to begin with."""
        chosen = "" if photograph is None else f"#{quote(str(photograph))}"
        return f"http://{_LOOPBACK}:{self.port}/{self.token}/{chosen}"

    @property
    def origin(self) -> str:
        """Where its own requests come from."""
        return f"http://{_LOOPBACK}:{self.port}"


def create_viewer(settings: Settings, address: Address, dropped: Path) -> ASGIApp:
    """The ASGI application.

    Args:
        settings: the roots below which photographs are listed; ``dropped`` must be one of them.
        address: where it will be reached.
        dropped: a folder of this session for photographs that are dropped.
    """
    services = create_services(settings)
    shows_pages = [advertise(EXTENSION_ID, {"mimeTypes": [APP_MIME_TYPE]})]

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        services.preload()
        try:
            async with Client(create_server(services), extensions=shows_pages) as client:
                app.state.client = client
                yield
        finally:
            services.close()

    async def page(_: Request) -> Response:
        return HTMLResponse(view_html(), headers=_HEADERS)

    async def call(request: Request) -> Response:
        question = await _question(request)
        if question is None:
            return PlainTextResponse("send JSON with name and arguments of a tool", 400)
        lines = _lines(request.app.state.client, *question)
        return StreamingResponse(lines, media_type="application/x-ndjson", headers=_HEADERS)

    async def photographs(request: Request) -> Response:
        return await _keep(request, dropped, settings.image_limits.max_bytes)

    below = f"/{address.token}"
    routes = [
        Route(f"{below}/", page),
        Route(f"{below}/call", call, methods=["POST"]),
        Route(f"{below}/photographs", photographs, methods=["POST"]),
    ]
    return _OwnPageOnly(Starlette(routes=routes, lifespan=lifespan), address)


def serve_viewer(settings: Settings, photograph: Path | None, port: int, opened: Callable[[str], object]) -> None:
    """Serve the page until told to stop.

    Args:
        settings: as for ``create_viewer``; a folder for dropped photographs is added to its roots.
        photograph: below a root, to begin with.
        port: of 127.0.0.1; 0 for any that is free.
        opened: is told the address once the port is ours.

    Raises:
        OSError: the port is taken.
    """
    signal.signal(signal.SIGTERM, _end)  # uvicorn hands the signal on: the folder must go first
    with tempfile.TemporaryDirectory(prefix="vehanchor-view-") as folder, socket.socket() as listening:
        listening.bind((_LOOPBACK, port))
        listening.listen()
        address = Address(listening.getsockname()[1])
        dropped = Path(folder).resolve()
        settings = replace(settings, roots=(*settings.roots, dropped))
        opened(address.url(photograph))
        app = create_viewer(settings, address, dropped)
        logging.disable(logging.INFO)  # a person reads this terminal
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=_SHUTDOWN_S,
        )
        uvicorn.Server(config).run(sockets=[listening])


def _end(*_: object) -> None:
    raise SystemExit(128 + signal.SIGTERM)


class _OwnPageOnly:
    """ASGI middleware that answers the page itself and nobody else."""

    def __init__(self, app: ASGIApp, address: Address) -> None:
        self._app = app
        self._address = address
        self._host = f"{_LOOPBACK}:{address.port}".encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or refuse it."""
        if scope["type"] == "http" and not self._is_own(scope):
            await PlainTextResponse("not found", 404)(scope, receive, send)  # no word about what there is
        elif scope["type"] in ("http", "lifespan"):
            await self._app(scope, receive, send)

    def _is_own(self, scope: Scope) -> bool:
        headers: list[tuple[bytes, bytes]] = scope["headers"]
        said = {name: [value for each, value in headers if each == name] for name, _ in headers}
        token = scope["path"].lstrip("/").partition("/")[0].encode()
        return (
            said.get(b"host") == [self._host]  # another name for this address is a rebound one
            and said.get(b"origin", [self._address.origin.encode()]) == [self._address.origin.encode()]
            and said.get(b"sec-fetch-site", [b"none"]) in ([b"none"], [b"same-origin"])
            and secrets.compare_digest(token, self._address.token.encode())
        )


async def _question(request: Request) -> tuple[str, dict[str, Any]] | None:
    """A tool's name and arguments; None where the body is something else."""
    if request.headers.get("content-type") != "application/json":
        return None
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MAX_CALL_BYTES:
            return None
    try:
        asked = json.loads(body)
        name, arguments = asked["name"], asked["arguments"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return (name, arguments) if isinstance(name, str) and isinstance(arguments, dict) else None


async def _lines(client: Client, name: str, arguments: dict[str, Any]) -> AsyncIterator[str]:
    """How far a call is, and its result last; each a line of JSON. The call ends when nobody listens any more."""
    sending, receiving = anyio.create_memory_object_stream[dict[str, Any]](100)

    async def report(progress: float, total: float | None, message: str | None) -> None:
        del total  # always 100
        await sending.send({"progress": progress, "message": message})

    async def ask() -> None:
        try:
            result = _on_the_wire(await client.call_tool(name, arguments, progress_callback=report))
        except MCPError as error:
            result = {"isError": True, "content": [{"type": "text", "text": str(error)}]}
        await sending.send({"result": result})
        sending.close()

    async with anyio.create_task_group() as tasks, receiving:
        tasks.start_soon(ask)
        async for line in receiving:
            yield json.dumps(line) + "\n"


def _on_the_wire(result: CallToolResult) -> dict[str, Any]:
    return result.model_dump(mode="json", by_alias=True, exclude_none=True)


async def _keep(request: Request, folder: Path, max_bytes: int) -> Response:
    """Keep a photograph that was dropped, below its content's name, so that the same one is kept once."""
    if request.headers.get("content-type") != "application/octet-stream":
        return PlainTextResponse("send the photograph's bytes", 400)
    named = Path(request.query_params.get("name", "")).name
    name = re.sub(r"[^\w.() -]", "_", named)[-100:].lstrip(".") or "photograph"
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        if len(data) > max_bytes:
            return PlainTextResponse(f"{name} has more than {max_bytes >> 20} MiB: reduce it", 413)
    below = folder / hashlib.sha256(data).hexdigest()[:16]
    if len(list(folder.iterdir())) >= _MAX_DROPPED and not below.exists():
        return PlainTextResponse(f"more than {_MAX_DROPPED} photographs: open their folder with 'vehanchor view'", 413)

    def write() -> None:
        below.mkdir(exist_ok=True)
        (below / name).write_bytes(data)

    await anyio.to_thread.run_sync(write)
    return JSONResponse({"path": str(below / name)}, headers=_HEADERS)
