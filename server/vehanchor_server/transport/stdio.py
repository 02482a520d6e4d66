"""The server over stdio, as a child process of its host."""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING

import anyio

from vehanchor_server.app import create_server
from vehanchor_server.request_log import configure_logging
from vehanchor_server.services import create_services

if TYPE_CHECKING:
    from vehanchor_server.services import Services
    from vehanchor_server.settings import Settings

PRELOAD_DELAY_S = 1.0  # so that loading does not delay the first answers
_GRACE_S = 1.0  # time for stopped calls to end


def serve_stdio(settings: Settings) -> None:
    """Serve until stdin ends, or until SIGTERM or SIGINT; write only the protocol to stdout.

    Args:
        settings: the operator's settings.
    """
    configure_logging()
    services = create_services(settings)
    services.preload(PRELOAD_DELAY_S)
    anyio.run(_serve, services)
    _leave(services)


async def _serve(services: Services) -> None:
    async with anyio.create_task_group() as group:
        if sys.platform != "win32":
            group.start_soon(_leave_on_signal, services)
        await create_server(services).run_stdio_async()
        services.close()
        group.cancel_scope.cancel()


async def _leave_on_signal(services: Services) -> None:
    """End the process on a signal, after the stopped calls or after a period of grace."""
    with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
        async for _ in signals:
            services.close()
            with anyio.move_on_after(_GRACE_S):
                while services.capacity.running:
                    await anyio.sleep(0.01)
            _leave(services)


def _leave(services: Services) -> None:
    """End the process at once: the interpreter would wait for the thread that reads stdin."""
    if services.workers is not None:
        services.workers.remove_socket()
    sys.stderr.flush()
    os._exit(0)
