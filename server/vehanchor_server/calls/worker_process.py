"""Main function and resource limits of a worker process."""

from __future__ import annotations

import contextlib
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

from vehanchor.analysis.heap import map_large_blocks, return_freed, use_one_heap
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

    from vehanchor_server.calls.task import Task
    from vehanchor_server.resources import Resources

# Idle time before freed memory is returned.
_IDLE_S = 5.0
# Errors of OpenCV, C++ and ONNX Runtime.
_OUT_OF_MEMORY = ("Insufficient memory", "bad_alloc", "bad allocation", "Failed to allocate")
_DATA_PAGES = 5  # position of the size of the data in /proc/self/statm
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
    """Confine this process, load the models and run tasks until the server ends.

    This is the main function of a worker.

    Args:
        connection: connection to the server, for messages.
        log: pipe for log lines, which the server labels and limits.
        make_resources: creates the resources of the worker.
        limits: resource limits of the worker.
    """
    _prepare_process(connection, log)
    try:
        resources = make_resources()
        confinement = _confine(resources)
        # After the confinement: Landlock holds for threads that start later.
        threading.Thread(
            target=_end_with_server, args=(connection,), name="vehanchor-server", daemon=True
        ).start()
        resources.models.load_all()
        return_freed()
    except Exception:
        send(connection, _bug())
        return
    _limit_memory(limits.memory_bytes)
    send(connection, Loaded(failure=resources.models.failure, confinement=confinement))
    # The connection ends with the server, or when the server releases this worker.
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            if not connection.poll(_IDLE_S):
                return_freed()
            task = connection.recv()
            _limit_cpu(limits.cpu_s)
            failure = _run_task(resources, task, connection)
            if failure is not None:
                send(connection, failure)
            del task  # its image, while the worker waits


def _prepare_process(connection: Connection, log: Connection) -> None:
    """Set up memory, signals, descriptors and logging of a new process."""
    from vehanchor_server.request_log import configure_logging

    # A worker shares memory with the fork server. Garbage collections would write to it, and so
    # copy it.
    gc.freeze()
    use_one_heap()
    map_large_blocks()
    # Ctrl-C reaches all processes; the server ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _keep_streams(connection, log)
    configure_logging()


def _confine(resources: Resources) -> Confinement:
    """Confine this process, unless the settings forbid it."""
    readable = resources.readable
    if readable is None:
        return Confinement(lacks="the operator's settings")
    return confine(readable)


def _keep_streams(connection: Connection, log: Connection) -> None:
    """Keep the server's connection and the log; close all other inherited descriptors.

    Standard input can be the server's protocol or the operator's terminal, and standard error can
    be the terminal. One descriptor of ``multiprocessing`` leads to the process that removes shared
    memory.
    """
    for stream in (1, 2):
        os.dup2(log.fileno(), stream)
    log.close()
    # Elsewhere ``multiprocessing`` watches the server by a descriptor of its own.
    if sys.platform != "linux":
        return
    empty_input = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty_input, 0)
    descriptor = connection.fileno()
    os.closerange(3, descriptor)
    os.closerange(descriptor + 1, os.sysconf("SC_OPEN_MAX"))


def _run_task(resources: Resources, task: Task[Any], connection: Connection) -> Refused | None:
    """Run a task and send its reply; otherwise return the message for the failure."""

    def report(percent: float, message: str) -> None:
        send(connection, Progressed(percent=percent, message=message))

    try:
        reply = perform(resources, task, Job(Stop(), report))
        send_reply(connection, reply)
        return None
    except Exception as error:
        if _is_out_of_memory(error):
            _logger.warning("a worker ran out of memory", exc_info=True)
            return Refused(
                code=WORKER_KILLED,
                message="the image needs more memory than this server allows. Send a smaller "
                "image.",
            )
        if isinstance(error, CallError):
            return Refused(code=error.code, message=error.explanation[:MAX_WORDS])
        return _bug()


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an error is for lack of memory; libraries state it in various ways."""
    message = str(error)
    return isinstance(error, MemoryError) or any(words in message for words in _OUT_OF_MEMORY)


def _bug() -> Refused:
    """Return the message for the exception that is being handled."""
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
    """Limit the data that this process can add, on Linux: other systems do not count all data.

    The limit is relative to the current data, because threads reserve 8 MiB each and their number
    varies.
    """
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
        current_bytes = int(pages[_DATA_PAGES]) * resource.getpagesize()
        limit = current_bytes + n_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _limit_cpu(seconds: float) -> None:
    """Limit the further processor time of this process; the system kills it at the limit."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        usage = resource.getrusage(resource.RUSAGE_SELF)
        used = usage.ru_utime + usage.ru_stime
        limit = int(used + seconds) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
