"""Main function and resource limits of a worker process."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import logging
import multiprocessing
import os
import select
import signal
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor_server.calls.capacity import Stop
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.messages import (
    BUG,
    MAX_WORDS,
    Loaded,
    Progressed,
    Refused,
    send,
    send_reply,
)
from vehanchor_server.calls.task import perform
from vehanchor_server.errors import WORKER_KILLED, CallError
from vehanchor_server.sandbox.confinement import Confinement, confine

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection

    from vehanchor_server.calls.messages import WorkerMessage
    from vehanchor_server.calls.task import Task
    from vehanchor_server.resources import Resources

# idle time before freed memory is returned; a call after that maps it again, for some 25 ms
_IDLE_S = 5.0
# of malloc.h
_M_ARENA_MAX = -8
_M_MMAP_THRESHOLD = -3
# one heap; freed large blocks leave the process
_MEMORY_OPTIONS = ((_M_ARENA_MAX, 1), (_M_MMAP_THRESHOLD, 8 << 20))
# OpenCV's, C++'s, ONNX's
_OUT_OF_MEMORY = ("Insufficient memory", "bad_alloc", "bad allocation", "Failed to allocate")
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class WorkerLimits:
    """Resource limits of one worker.

    Attributes:
        memory_bytes: data in addition to the loaded models.
        cpu_s: processor time per call.
    """

    memory_bytes: int
    cpu_s: float


def serve_tasks(
    connection: Connection,
    log: Connection,
    make_resources: Callable[[], Resources],
    limits: WorkerLimits,
) -> None:
    """Confine this process, load the models and run tasks until the server ends: the main function of a worker.

    Args:
        connection: connection to the server, for messages.
        log: pipe for log lines, which the server labels and limits.
        make_resources: creates the resources of the worker.
        limits: resource limits of the worker.
    """
    from vehanchor_server.request_log import configure_logging

    # collections would write to what the fork server made, and so copy the memory that is shared
    # with it
    gc.freeze()
    for option, value in _MEMORY_OPTIONS:
        _glibc("mallopt", option, value)
    # Ctrl-C reaches all processes; the server ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _keep_streams(connection, log)
    configure_logging()
    try:
        resources = make_resources()
        readable = resources.readable
        confinement = (
            Confinement(lacks="the operator's settings") if readable is None else confine(readable)
        )
        threading.Thread(
            target=_end_with_server, args=(connection,), name="vehanchor-server", daemon=True
        ).start()
        resources.models.load_all()
        _glibc("malloc_trim", 0)
    except Exception:
        send(connection, _bug())
        return
    _limit_memory(limits.memory_bytes)
    send(connection, Loaded(failure=resources.models.failure, confinement=confinement))
    # the server ended, or released this worker
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            if not connection.poll(_IDLE_S):
                _glibc("malloc_trim", 0)
            task = connection.recv()
            _limit_cpu(limits.cpu_s)
            failure = _outcome(resources, task, connection)
            if failure is not None:
                send(connection, failure)
            del task


def _keep_streams(connection: Connection, log: Connection) -> None:
    """Keep the server's connection and the log; close all other inherited descriptors.

    Standard input can be the server's protocol or the operator's terminal, and standard error can
    be the terminal. One descriptor of ``multiprocessing`` leads to the process that removes shared
    memory.
    """
    for stream in (1, 2):
        os.dup2(log.fileno(), stream)
    log.close()
    # elsewhere ``multiprocessing`` watches the server by its own descriptor
    if sys.platform != "linux":
        return
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    kept = connection.fileno()
    os.closerange(3, kept)
    os.closerange(kept + 1, os.sysconf("SC_OPEN_MAX"))


def _outcome(resources: Resources, task: Task[Any], connection: Connection) -> WorkerMessage | None:
    """Run a task and send its reply; otherwise return the message for the failure."""

    def report(percent: float, message: str) -> None:
        send(connection, Progressed(percent=percent, message=message))

    try:
        send_reply(connection, perform(resources, task, Job(Stop(), report)))
        return None
    except Exception as error:
        if isinstance(error, MemoryError) or any(words in str(error) for words in _OUT_OF_MEMORY):
            _logger.warning("a worker ran out of memory", exc_info=True)
            needs = "the image needs more memory than this server allows. Send a smaller image."
            return Refused(code=WORKER_KILLED, message=needs)
        if isinstance(error, CallError):
            return Refused(code=error.code, message=error.explanation[:MAX_WORDS])
        return _bug()


def _bug() -> Refused:
    return Refused(code=BUG, message=traceback.format_exc()[-MAX_WORDS:])


def _end_with_server(connection: Connection) -> None:
    """End this process when the server ends, even during a call."""
    if sys.platform == "linux":
        hangup = select.poll()
        hangup.register(connection.fileno(), select.POLLRDHUP)
        hangup.poll()
    else:
        server = multiprocessing.parent_process()
        assert server is not None
        server.join()
    os._exit(0)


def _limit_memory(n_bytes: int) -> None:
    """Limit the data that this process can add; only on Linux, as other systems do not count all data.

    The limit is relative to the current data, because threads reserve 8 MiB each and their number
    varies.
    """
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        has = (
            int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5])
            * resource.getpagesize()
        )
        resource.setrlimit(resource.RLIMIT_DATA, (has + n_bytes, has + n_bytes))


def _glibc(function: str, *arguments: int) -> None:
    """Call a function of glibc's memory allocator, if there is one."""
    # TypeError: Windows has no CDLL of itself
    with contextlib.suppress(OSError, TypeError, AttributeError):
        getattr(ctypes.CDLL(None), function)(*arguments)


def _limit_cpu(seconds: float) -> None:
    """Limit the further processor time of this process; the system kills it at the limit."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
        resource.setrlimit(resource.RLIMIT_CPU, (int(used + seconds) + 1, resource.RLIM_INFINITY))
