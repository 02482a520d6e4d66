"""The server over Streamable HTTP.

It is stateless in both eras of the protocol, so that any replica answers any request.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from mcp.server.auth.settings import AuthSettings
from mcp.server.transport_security import TransportSecuritySettings
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from vehanchor_server.app import create_server
from vehanchor_server.request_log import configure_logging
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import MAX_BODY_BYTES, Settings
from vehanchor_server.transport.auth import token_verifier
from vehanchor_server.transport.json_reply import JsonReply
from vehanchor_server.transport.request_guard import RequestGuard

MCP_PATH = "/mcp"
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_SHUTDOWN_S = 5  # time for running calls after a stop
# Above the proxy's 3 s in examples/deploy/nginx.conf, so that no call meets a closed connection.
_KEEP_ALIVE_S = 5
_MAX_HEAD_BYTES = 32 << 10
_SPARE_BODIES = 2  # besides one per call: a call's slot is free shortly before its body


def create_app(settings: Settings) -> Starlette:
    """Create the ASGI application.

    Args:
        settings: the operator's settings.

    Raises:
        SettingsError: a setting is invalid, or a public server has no authentication.
    """
    settings.check_exposure()
    services = create_services(settings)
    verifier = token_verifier(settings)
    auth = None if verifier is None else _auth(settings)
    server = create_server(services, auth=auth, token_verifier=verifier)

    async def healthz(_: Request) -> Response:
        return JSONResponse({"status": "alive"})

    async def readyz(_: Request) -> Response:
        if services.ready:
            return JSONResponse({"status": "ready"})
        return JSONResponse({"status": "loading", "error": services.failure}, status_code=503)

    app = server.streamable_http_app(
        streamable_http_path=MCP_PATH,
        stateless_http=True,
        max_request_body_size=MAX_BODY_BYTES,
        transport_security=_transport_security(settings),
    )
    max_large_bodies = services.capacity.max_concurrency + _SPARE_BODIES
    app.add_middleware(JsonReply)
    app.add_middleware(RequestGuard, path=MCP_PATH, max_large_bodies=max_large_bodies)
    # Probes of load balancers have no token.
    app.router.routes += [Route("/healthz", healthz), Route("/readyz", readyz)]
    end_with(app, services)
    return app


def end_with(app: Starlette, services: Services) -> None:
    """Load the models when the application starts, and stop all calls and workers when it ends."""
    lifespan = app.router.lifespan_context

    @asynccontextmanager
    async def whole(app: Starlette) -> AsyncIterator[Any]:
        loading = services.preload()
        try:
            async with lifespan(app) as state:
                yield state
        finally:
            services.close()
            loading.cancel()
            loading.join()  # ONNX Runtime aborts a process that ends while it opens a model

    app.router.lifespan_context = whole


def serve_http(settings: Settings) -> None:
    """Listen until a stop signal.

    Args:
        settings: the operator's settings.

    Raises:
        SettingsError: the token file is invalid, or a public server has no authentication.
    """
    configure_logging()
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        http="h11",  # httptools has no limit on the head
        h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=_KEEP_ALIVE_S,
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )


def _auth(settings: Settings) -> AuthSettings:
    """Return what the SDK states about authentication to callers without a valid token."""
    if settings.public_urls:
        address = settings.public_urls[0]
    else:
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        address = f"http://{host}:{settings.port}{MCP_PATH}"
    if settings.oidc is None:  # the operator's own tokens have no authorization server
        return AuthSettings.model_validate({"issuer_url": address, "resource_server_url": None})
    issuer, _ = settings.issuer
    # From strings, so that an issuer without a path gains no slash.
    return AuthSettings.model_validate(
        {
            "issuer_url": issuer,
            "resource_server_url": address,
            "validate_token_resource": False,  # the verifier checks the audience
        }
    )


def _transport_security(settings: Settings) -> TransportSecuritySettings:
    """Return the accepted Host and Origin headers.

    Others are refused, so that no web page uses the server through its visitors.
    """
    hosts = []
    for name in _LOOPBACK_NAMES:
        hosts += [name, f"{name}:*"]
    origins = [f"http://{host}" for host in hosts]
    for url in map(urlsplit, settings.public_urls):
        hosts.append(url.netloc)
        if not url.port:
            hosts.append(f"{url.netloc}:*")
        origins.append(f"{url.scheme}://{url.netloc}")
    return TransportSecuritySettings(allowed_hosts=hosts, allowed_origins=origins)
