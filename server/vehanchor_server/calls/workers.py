"""Worker processes for decoding and models, which the server can kill.

Each worker loads its models and waits for a call. A thread of the server sends it the call and
forwards its progress. At the deadline, or if the call is cancelled, the server kills the worker and
starts the next one. The system limits the worker's memory, processor time, files and system calls
(``sandbox``). The server starts one worker at first, and another when concurrency reaches a new
maximum. An idle worker returns freed memory.

The processes and pipes are those of ``multiprocessing``. No existing pool fits:
``anyio.to_process`` kills, but reports no progress and loses log lines; in ``concurrent.futures``
and ``loky`` one killed worker breaks the whole pool; ``pebble`` is under the LGPL.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import multiprocessing.util
import shutil
import sys
import tempfile
import threading
from typing import TYPE_CHECKING

from vehanchor_server.calls.capacity import CallStoppedError
from vehanchor_server.calls.messages import (
    BUG,
    Loaded,
    MessageError,
    Progressed,
    Refused,
    Replied,
    receive,
    receive_reply,
)
from vehanchor_server.calls.worker_log import forward_log
from vehanchor_server.calls.worker_process import serve_tasks
from vehanchor_server.errors import WORKER_KILLED, CallError
from vehanchor_server.models import SLOW_IMPORTS
from vehanchor_server.sandbox.environment import minimal_environment

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.context import ForkServerContext, SpawnContext

    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.calls.task import Record, Task
    from vehanchor_server.calls.worker_process import WorkerLimits
    from vehanchor_server.resources import Resources
    from vehanchor_server.sandbox.confinement import Confinement

_ENDS_WITHIN_S = 5.0  # a killed process, unless the system is stuck
_POLL_S = 0.05  # interval at which a waiting thread checks for a stop request
_logger = logging.getLogger(__name__)


class WorkerPool:
    """Workers of a server, at most one per concurrent call.

    Args:
        make_resources: creates the resources of a worker: a module-level function or a ``functools.partial``
            of one.
        limits: resource limits of each worker.

    Attributes:
        make_resources: as given.
        limits: as given.
        closed: whether all workers were ended.
        failure: error code of the last failed load of the models, or None.
    """

    def __init__(self, make_resources: Callable[[], Resources], limits: WorkerLimits) -> None:
        self.make_resources = make_resources
        self.limits = limits
        self.closed = False
        self.failure: str | None = None
        self._lock = threading.RLock()
        self._workers: list[_Worker] = []  # all that have not ended
        self._idle: list[_Worker] = []
        self._logged: set[str] = set()

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self.failure is None and any(worker.loaded for worker in tuple(self._workers))

    @property
    def processes(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in tuple(self._workers) if worker.process.pid]

    def log_once(self, level: int, text: str) -> None:
        """Log a message that all workers share once."""
        if text not in self._logged:
            self._logged.add(text)
            _logger.log(level, text)

    def start(self) -> None:
        """Start the first worker, unless a call has done so."""
        with self._lock:
            if not self._workers and not self.closed:
                self._idle.append(self._new())

    def run(
        self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Run a task in a worker; blocks, so call it in a thread.

        Args:
            task: the task.
            stop: kills the worker on request.
            report: receives progress.

        Raises:
            CallError: ``worker_killed``, ``worker_unavailable``, or the failure of the work.
            CallStoppedError: a stop was requested.
            RuntimeError: a bug in the worker; the message has its traceback.
        """
        worker = self._take(stop)
        try:
            return worker.run(task, stop, report)
        finally:
            if worker.usable:
                self._idle.append(worker)
            else:
                self._end(worker)
                if not self.closed:
                    self._idle.append(self._new())

    def close(self) -> None:
        """End all workers."""
        self.closed = True
        for worker in tuple(self._workers):
            worker.kill()

    def remove_socket(self) -> None:
        """Close the pool and remove the workers' socket, for a process that ends without exit handlers."""
        self.close()
        if self.processes:
            with contextlib.suppress(OSError):  # a read-only file system has none
                shutil.rmtree(multiprocessing.util.get_temp_dir(), ignore_errors=True)

    def _take(self, stop: Stop) -> _Worker:
        """Take an idle worker and wait for its models; start another one if the system kills it meanwhile."""
        for _ in range(2):
            with self._lock:
                for each in [each for each in self._idle if each.has_failed]:
                    self._idle.remove(each)
                    self._end(each)
                worker = max(self._idle, key=lambda each: each.loaded, default=None)
                if worker is not None:
                    self._idle.remove(worker)
            worker = worker or self._new()
            try:
                worker.await_loaded(stop)
            except CallStoppedError:  # loading continues
                self._idle.append(worker)
                raise
            if worker.usable:
                return worker
            self._end(worker)
            if (worker.process.exitcode or 0) >= 0 or self.closed:  # no signal ended it
                break
        raise CallError(
            "worker_unavailable",
            "this server's worker process does not start; the image is not the cause. Try again "
            "in a while; if that "
            "does not help, its operator must check the server's log.",
        )

    def _new(self) -> _Worker:
        worker = _Worker(self)
        with self._lock:
            self._workers.append(worker)
        if self.closed:
            worker.kill()
        return worker

    def _end(self, worker: _Worker) -> None:
        with self._lock:
            self._workers.remove(worker)
        worker.end()


class _Worker:
    """One worker: a process that starts at once; an error of the start is its failure."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._settled = threading.Event()  # its models are loaded, or it has failed
        self._waits = self._killed = False
        self.loaded = False
        context = _start_context()
        self._connection, theirs = context.Pipe()
        log, written = context.Pipe(duplex=False)
        self.process = context.Process(
            target=serve_tasks,
            args=(theirs, written, pool.make_resources, pool.limits),
            name="vehanchor-worker",
            daemon=True,
        )
        try:
            with theirs, written, minimal_environment():
                self.process.start()
            forward_log(log, self.process.pid or 0)
            threading.Thread(target=self._load, name="vehanchor-loading", daemon=True).start()
        # no memory, process or thread, or a missing fork server
        except (OSError, EOFError, RuntimeError) as error:
            log.close()
            self._fail(f"no process can be started: {error!r}")

    @property
    def usable(self) -> bool:
        """Whether the process waits for a task."""
        return self._waits and not self._killed and self.process.is_alive()

    @property
    def has_failed(self) -> bool:
        """Whether it will run no task any more."""
        return self._settled.is_set() and not self.usable

    def kill(self) -> None:
        """Kill the process."""
        self._killed = True
        if self.process.pid is not None:
            self.process.kill()

    def end(self) -> None:
        """Kill the process and release what it held."""
        self.kill()
        if self.process.pid is not None:
            self.process.join(_ENDS_WITHIN_S)
        self._connection.close()

    def await_loaded(self, stop: Stop) -> None:
        """Wait until the models are loaded, the process has failed, or a stop is requested."""
        while not self._settled.wait(_POLL_S):
            stop.check()

    def _load(self) -> None:
        """Wait for the worker's first message, in a thread."""
        try:
            message = receive(self._connection)
        except (EOFError, OSError, MessageError):
            self.process.join(_ENDS_WITHIN_S)
            self._fail(f"it ended with exit code {self.process.exitcode} during startup")
            return
        if not isinstance(message, Loaded):
            self._fail(
                message.message if isinstance(message, Refused) else f"it sent {message.kind}"
            )
            return
        self._pool.failure = message.failure
        self._pool.log_once(*_confinement_message(message.confinement))
        self.loaded = self._waits = True
        self._settled.set()

    def _fail(self, reason: str) -> None:
        if not self._pool.closed:
            self._pool.failure = "worker_unavailable"
            self._pool.log_once(logging.ERROR, f"a worker cannot start: {reason}")
        self._settled.set()

    def run(
        self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Run a task as the pool does; a stop request kills the process."""
        self._waits = False
        with stop.calling(self.kill):
            stop.check()
            try:
                self._connection.send(task)
                return self._listen(task, report)
            # the process ended, or sent other bytes, or too many
            except (EOFError, OSError, MessageError) as error:
                self.kill()  # does not change the exit code of one that ended
                self.process.join(_ENDS_WITHIN_S)
                stop.check()
                cause = (
                    error
                    if isinstance(error, MessageError)
                    else f"exit code {self.process.exitcode}"
                )
                _logger.warning("a worker ended during a call: %s", cause)
                raise CallError(
                    WORKER_KILLED,
                    "the worker process ended: it used too much memory or time, or crashed. Try "
                    "again, or send another "
                    "image.",
                ) from error

    def _listen(self, task: Task[Record], report: Callable[[float, str], None]) -> Reply[Record]:
        while True:
            match message := receive(self._connection):
                case Progressed():
                    report(message.percent, message.message)
                case Replied():
                    reply = receive_reply(self._connection, message, task.work.record)
                    self._waits = True
                    return reply
                case Refused():
                    self._waits = message.code != WORKER_KILLED
                    if message.code == BUG:
                        raise RuntimeError(f"in a worker: {message.message}")
                    raise CallError(message.code, message.message)
                case _:
                    raise MessageError(f"{message.kind} during a call")


def _confinement_message(confinement: Confinement) -> tuple[int, str]:
    """Describe the confinement of workers for the log."""
    held = [f"Landlock {confinement.landlock}"] * bool(confinement.landlock) + [
        "seccomp"
    ] * confinement.seccomp
    text = f"workers are confined by {' and '.join(held)}" if held else "workers are not confined"
    return (
        (logging.WARNING, f"{text} ({confinement.lacks})")
        if confinement.lacks
        else (logging.INFO, text)
    )


def _start_context() -> ForkServerContext | SpawnContext:
    """Return the start method: on Linux a fork server with all modules imported, for fast replacement.

    The fork server opens no models, because a fork loses their threads. It needs a directory for
    its socket.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a read-only file system: spawn instead
            tempfile.gettempdir()
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload(
                [serve_tasks.__module__, "vehanchor_server.resources", *SLOW_IMPORTS]
            )
            return context
    return multiprocessing.get_context("spawn")
