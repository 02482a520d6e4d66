"""The process of a worker: what it does from its start to its end, and what it may take of the machine."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import multiprocessing
import os
import signal
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor_server.calls.capacity import Stop
from vehanchor_server.calls.confinement import Confinement, confine
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.task import perform
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection

    from vehanchor_server.calls.task import Parts, Task

__all__ = ["WorkerLimits", "serve_tasks"]

_IDLE_S = 0.5  # then memory is given back; after each call the next one would wait for its pages
_OUT_OF_MEMORY = ("Insufficient memory", "bad_alloc", "bad allocation", "Failed to allocate")  # OpenCV's, C++'s, ONNX's
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkerLimits:
    """What one worker may use.

    Attributes:
        memory_bytes: of data, beside what it has with its models loaded.
        cpu_s: processor time of a call.
    """

    memory_bytes: int
    cpu_s: float


def serve_tasks(connection: Connection, make_services: Callable[[], Parts], limits: WorkerLimits) -> None:
    """Confine this process, load the models and do tasks until the server is gone; the main function of a worker."""
    from vehanchor_server.request_log import configure_logging

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # from the keyboard it comes to all, and the server ends its workers
    os.dup2(2, 1)  # stdout belongs to the server's protocol
    configure_logging()
    try:
        services = make_services()
        confinement = _confined(services.readable)
        threading.Thread(target=_end_with_server, name="vehanchor-server", daemon=True).start()
        services.models.load_all()
    except Exception:
        connection.send(("broken", traceback.format_exc()))
        return
    _limit_memory(limits.memory_bytes)
    connection.send(("loaded", services.models.failure, confinement))
    with contextlib.suppress(EOFError, ConnectionError):  # the server is gone, or has let this worker go
        while True:
            if not connection.poll(_IDLE_S):
                _give_back_memory()
            task = connection.recv()
            _limit_cpu(limits.cpu_s)
            connection.send(_outcome(services, task, connection))
            del task


def _confined(readable: tuple[Path, ...] | None) -> Confinement:
    return Confinement(lacks="the operator's settings") if readable is None else confine(readable)


def _outcome(services: Parts, task: Task[Any], connection: Connection) -> tuple[Any, ...]:
    def enter(stage: str) -> None:
        connection.send(("enter", stage))

    def report(percent: float, message: str) -> None:
        connection.send(("report", percent, message))

    try:
        return "value", perform(services, task, Job(Stop(), report, enter))
    except Exception as error:
        if isinstance(error, MemoryError) or any(words in str(error) for words in _OUT_OF_MEMORY):
            _logger.warning("a worker ran out of memory", exc_info=True)
            return "exhausted", CallError(
                "worker_killed", "the work on the image took more memory than this server allows. Send a smaller image."
            )
        if isinstance(error, CallError):
            return "refused", error
        return "failed", traceback.format_exc()


def _end_with_server() -> None:
    """End this process when the server's does, also in the middle of a call."""
    server = multiprocessing.parent_process()
    assert server is not None
    server.join()
    os._exit(1)


def _limit_memory(n_bytes: int) -> None:
    """Limit the data that this process may still take; only on Linux, as no other system counts all of it.

    Relative to what it has: threads of models reserve 8 MiB each, so a machine with many cores begins with more.
    """
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        has = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (has + n_bytes, has + n_bytes))


def _give_back_memory() -> None:
    """Give freed memory back to the system, where the C library keeps it and can be told (glibc)."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # TypeError: Windows has no CDLL of itself
        ctypes.CDLL(None).malloc_trim(0)


def _limit_cpu(seconds: float) -> None:
    """Limit the processor time that this process may still take; the system kills it when it is used up."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        resource.setrlimit(resource.RLIMIT_CPU, (int(used + seconds) + 1, resource.RLIM_INFINITY))
