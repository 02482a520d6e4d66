"""The server over Streamable HTTP: stateless in both protocol eras, so that any process answers any request.

``uvicorn --factory vehanchor_server.transport.http:create_app --workers N`` also runs it, with settings from
``VEHANCHOR_*`` variables.
"""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from typing import Any

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
from vehanchor_server.settings import Settings
from vehanchor_server.transport.auth import token_verifier
from vehanchor_server.transport.request_guard import RequestGuard

MCP_PATH = "/mcp"
_SETTINGS_OF_WORKERS = "VEHANCHOR_SETTINGS_OF_WORKERS"  # JSON in one variable, because lists need no separators there
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_SHUTDOWN_S = 5  # time for running calls after a stop
_KEEP_ALIVE_S = 5  # above the proxy's 3 s in examples/deploy/nginx.conf, so that no call meets a closed connection
_MAX_HEAD_BYTES = 32 << 10
_SPARE_BODIES = 2  # besides one per call: a call's slot is free shortly before its body


def create_app(settings: Settings | None = None) -> Starlette:
    """Create the ASGI application.

    Args:
        settings: the operator's settings. None reads those of ``serve_http`` in its child processes, otherwise the
            environment, and configures the logs.

    Raises:
        SettingsError: a setting is invalid, or a public server has no authentication.
    """
    if settings is None:
        configure_logging()
        handed_down = os.environ.get(_SETTINGS_OF_WORKERS)
        settings = Settings.from_json(handed_down) if handed_down else Settings.from_environment()
    settings.check_exposure()
    services = create_services(settings)
    verifier = token_verifier(settings)
    server = create_server(services, auth=_auth(settings) if verifier else None, token_verifier=verifier)

    async def healthz(_: Request) -> Response:
        return JSONResponse({"status": "alive"})

    async def readyz(_: Request) -> Response:
        if services.ready:
            return JSONResponse({"status": "ready"})
        return JSONResponse({"status": "loading", "error": services.failure}, status_code=503)

    services.preload()
    security = _transport_security(settings)
    app = server.streamable_http_app(
        streamable_http_path=MCP_PATH,
        stateless_http=True,
        max_request_body_size=settings.max_body_bytes,
        transport_security=security,
    )
    app.add_middleware(
        RequestGuard,
        path=MCP_PATH,
        hosts=security.allowed_hosts,
        origins=security.allowed_origins,
        max_large_bodies=services.capacity.max_concurrency + _SPARE_BODIES,
    )
    app.router.lifespan_context = partial(_closing, services, app.router.lifespan_context)
    app.router.routes += [Route("/healthz", healthz), Route("/readyz", readyz)]  # probes have no token
    return app


@asynccontextmanager
async def _closing(
    services: Services, lifespan: Callable[[Starlette], AbstractAsyncContextManager[Any]], app: Starlette
) -> AsyncIterator[Any]:
    """Run the application's lifespan, then stop all calls and workers."""
    try:
        async with lifespan(app) as state:
            yield state
    finally:
        services.close()
        services.models.end_preload()


def serve_http(settings: Settings) -> None:
    """Listen until a stop signal.

    Args:
        settings: the operator's settings.

    Raises:
        SettingsError: a setting is invalid, or a public server has no authentication.
    """
    settings.check_exposure()
    token_verifier(settings)  # report an invalid token file before listening
    configure_logging()
    os.environ[_SETTINGS_OF_WORKERS] = settings.to_json()
    try:
        uvicorn.run(
            "vehanchor_server.transport.http:create_app",
            factory=True,
            host=settings.host,
            port=settings.port,
            workers=settings.workers,
            http="h11",  # httptools has no limit on the head
            h11_max_incomplete_event_size=_MAX_HEAD_BYTES,
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_keep_alive=_KEEP_ALIVE_S,
            timeout_graceful_shutdown=_SHUTDOWN_S,
        )
    finally:
        del os.environ[_SETTINGS_OF_WORKERS]


def _auth(settings: Settings) -> AuthSettings:
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    address = settings.public_url or f"http://{host}:{settings.port}{MCP_PATH}"
    if settings.oidc_issuer is None:  # the operator's own tokens have no authorization server
        return AuthSettings.model_validate({"issuer_url": address, "resource_server_url": None})
    return AuthSettings.model_validate(  # from strings, so that an issuer without a path gains no slash
        {
            "issuer_url": settings.oidc_issuer,
            "resource_server_url": address,
            "validate_token_resource": False,  # the verifier checks the audience
        }
    )


def _transport_security(settings: Settings) -> TransportSecuritySettings:
    """Return the accepted Host and Origin headers, so that no web page uses the server through its visitors."""
    hosts = [*_LOOPBACK_NAMES, *(f"{name}:*" for name in _LOOPBACK_NAMES)]
    for host in settings.allowed_hosts:
        hosts += [host] if ":" in host.rpartition("]")[2] else [host, f"{host}:*"]
    origins = [f"http://{name}" for name in _LOOPBACK_NAMES]
    return TransportSecuritySettings(
        enable_dns_rebinding_protection=True,
        allowed_hosts=hosts,
        allowed_origins=[*origins, *(f"{origin}:*" for origin in origins), *settings.allowed_origins],
    )
