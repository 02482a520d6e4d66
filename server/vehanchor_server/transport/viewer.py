"""Local viewer: ``vehanchor view`` serves the page and the tools to one browser, without an agent.

Access is limited to that browser: the address has a random token, Host must be this address, and
requests with the Origin or Sec-Fetch-Site of another page are refused.
"""

from __future__ import annotations

import hashlib
import logging
import re
import secrets
import signal
import socket
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import anyio.to_thread
import uvicorn
from mcp.server.transport_security import TransportSecuritySettings
from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse
from starlette.routing import Route

from vehanchor.errors import ImageTooLargeError, VehAnchorError
from vehanchor.imagery.file_check import check_file
from vehanchor_server.app import create_server
from vehanchor_server.app_page.page import view_html
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings, SettingsError
from vehanchor_server.transport.http import MCP_PATH, end_with

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import ASGIApp, Receive, Scope, Send

    from vehanchor.options import ImageLimits

_LOOPBACK = "127.0.0.1"
_TOKEN_BYTES = 24
_MAX_DROPPED = 500  # photographs per session, in a temporary folder
# One person's calls: a measurement, a thumbnail, a part in full resolution, and those that end.
_MAX_CALLS = 8
_MAX_NAME_CHARS = 100
_SHUTDOWN_S = 2
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",  # the token stays in this browser
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",  # the page has the other rules
}


@dataclass(frozen=True)
class Address:
    """Address of the page.

    Attributes:
        port: port on 127.0.0.1.
        token: random first path component.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(_TOKEN_BYTES))

    def url(self, photograph: Path | None = None) -> str:
        """Return the page's URL, with an initial photograph."""
        fragment = "" if photograph is None else f"#{quote(str(photograph))}"
        return f"{self.origin}/{self.token}/{fragment}"

    @property
    def origin(self) -> str:
        """Origin of the page's own requests."""
        return f"http://{_LOOPBACK}:{self.port}"


def create_viewer(settings: Settings, address: Address, dropped: Path) -> ASGIApp:
    """Create the ASGI application.

    Args:
        settings: settings whose roots have the photographs; ``dropped`` must be one of the roots.
        address: address of the page.
        dropped: folder for dropped photographs.
    """
    services = create_services(replace(settings, max_concurrency=_MAX_CALLS))

    async def page(_: Request) -> Response:
        return HTMLResponse(view_html(), headers=_HEADERS)

    async def photographs(request: Request) -> Response:
        return await _store_dropped(request, dropped, limits=settings.image_limits)

    below = f"/{address.token}"
    app = create_server(services).streamable_http_app(
        streamable_http_path=below + MCP_PATH,
        stateless_http=True,
        # ``_OwnPageOnly`` has stricter rules.
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),
    )
    app.router.routes += [
        Route(f"{below}/", page),
        Route(f"{below}/photographs", photographs, methods=["POST"]),
    ]
    end_with(app, services)
    return _OwnPageOnly(app, address)


def serve_viewer(
    settings: Settings, photograph: Path | None, port: int, opened: Callable[[str], object]
) -> None:
    """Serve the page until a stop signal.

    Args:
        settings: as for ``create_viewer``; a folder for dropped photographs is added to the roots.
        photograph: initial photograph below a root.
        port: port on 127.0.0.1; 0 for a free one.
        opened: receives the address once the server listens.

    Raises:
        SettingsError: the port is taken.
    """
    # uvicorn raises the signal again; as an exception, it lets the folder be removed first.
    signal.signal(signal.SIGTERM, _exit_on_signal)
    with (
        tempfile.TemporaryDirectory(prefix="vehanchor-view-") as folder,
        socket.socket() as listening,
    ):
        try:
            listening.bind((_LOOPBACK, port))
        except OSError as error:
            raise SettingsError(
                f"cannot listen on port {port}: {error.strerror}; use another --port"
            ) from None
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


def _exit_on_signal(*_: object) -> None:
    raise SystemExit(128 + signal.SIGTERM)


class _OwnPageOnly:
    """ASGI middleware that answers only requests of the page."""

    def __init__(self, app: ASGIApp, address: Address) -> None:
        self._app = app
        self._address = address

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "http" and not self._is_own(scope):
            refusal = PlainTextResponse("not found", 404)  # reveals nothing
            await refusal(scope, receive, send)
        elif scope["type"] in ("http", "lifespan"):
            await self._app(scope, receive, send)

    def _is_own(self, scope: Scope) -> bool:
        """Return whether the page itself, or the person's browser, makes this request."""
        headers = Headers(scope=scope)
        own_origin = self._address.origin
        # Another host name suggests DNS rebinding.
        if headers.getlist("host") != [own_origin.removeprefix("http://")]:
            return False
        if headers.getlist("origin") not in ([], [own_origin]):
            return False
        if headers.getlist("sec-fetch-site") not in ([], ["none"], ["same-origin"]):
            return False
        token = scope["path"].lstrip("/").partition("/")[0]
        return secrets.compare_digest(token.encode(), self._address.token.encode())


async def _store_dropped(request: Request, folder: Path, limits: ImageLimits) -> Response:
    """Store a dropped photograph below the hash of its content, so that duplicates are stored once.

    Args:
        request: its body has the bytes of the photograph, its query the name.
        folder: folder for dropped photographs.
        limits: limits on accepted images.
    """
    if request.headers.get("content-type") != "application/octet-stream":
        return PlainTextResponse("send the photograph's bytes", 400)
    name = _safe_name(request.query_params.get("name", ""))
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        # The rest of a file that is too large is not received.
        if len(data) > limits.max_bytes:
            break

    def read_at(offset: int, count: int) -> bytes:
        return bytes(data[offset : offset + count])

    try:
        check_file(read_at, len(data), name, limits=limits, on_disk=False)
    except VehAnchorError as error:
        status = 413 if isinstance(error, ImageTooLargeError) else 415
        return PlainTextResponse(f"{name} cannot be measured: {error}", status)
    content_folder = folder / hashlib.sha256(data).hexdigest()[:16]
    is_full = len(list(folder.iterdir())) >= _MAX_DROPPED
    if is_full and not content_folder.exists():
        return PlainTextResponse(
            f"more than {_MAX_DROPPED} photographs: open their folder with 'vehanchor view'", 413
        )
    path = content_folder / name

    def write() -> None:
        content_folder.mkdir(exist_ok=True)
        path.write_bytes(data)

    await anyio.to_thread.run_sync(write)
    return JSONResponse({"path": str(path)}, headers=_HEADERS)


def _safe_name(text: str) -> str:
    """Return a file name without folders, unusual characters and leading dots."""
    name = re.sub(r"[^\w.() -]", "_", Path(text).name)
    return name[-_MAX_NAME_CHARS:].lstrip(".") or "photograph"
