"""The server over stdio, as a child process of its host."""

from __future__ import annotations

import os
import signal
import sys
from io import TextIOWrapper
from typing import TYPE_CHECKING

import anyio
from mcp.server.stdio import stdio_server

from vehanchor_server.app import create_server
from vehanchor_server.request_log import configure_logging
from vehanchor_server.services import create_services
from vehanchor_server.transport.surrogates import without_lone_surrogates

if TYPE_CHECKING:
    from mcp.server import MCPServer

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
        await _answer(create_server(services))
        services.close()
        group.cancel_scope.cancel()


async def _answer(server: MCPServer[object]) -> None:
    """Answer the messages on stdin until it ends."""
    stdin = anyio.wrap_file(_stdin_of_messages())
    async with stdio_server(stdin) as (read_stream, write_stream):
        lowlevel = server._lowlevel_server
        options = lowlevel.create_initialization_options()
        await lowlevel.run(read_stream, write_stream, options)


class _Messages(TextIOWrapper):
    """Lines of JSON without lone surrogates."""

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        """Read one message."""
        line = super().readline(-1 if size is None else size)
        return without_lone_surrogates(line)


def _stdin_of_messages() -> _Messages:
    """Take stdin, so that child processes read its end only.

    The descriptor stays open to the end of the process, because a thread may wait for it.
    """
    descriptor = os.dup(sys.stdin.fileno())
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, sys.stdin.fileno())
    os.close(nothing)
    stream = os.fdopen(descriptor, "rb", closefd=False)
    return _Messages(stream, encoding="utf-8", errors="replace")


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
