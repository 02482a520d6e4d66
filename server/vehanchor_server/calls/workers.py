"""Worker processes for decoding and models, which the server can kill.

Each worker loads its models and waits for a call. A thread of the server sends it the call and forwards its progress.
At the deadline, or if the call is cancelled, the server kills the worker and starts the next one. The system limits
the worker's memory, processor time, files and system calls (``sandbox``). The server starts one worker at first, and
another when concurrency reaches a new maximum. An idle worker returns freed memory.

The processes and pipes are those of ``multiprocessing``. No existing pool fits: ``anyio.to_process`` kills, but
reports no progress and loses log lines; in ``concurrent.futures`` and ``loky`` one killed worker breaks the whole
pool; ``pebble`` is under the LGPL.
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
    Failed,
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
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext, SpawnContext
    from multiprocessing.process import BaseProcess

    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.calls.task import Record, Task
    from vehanchor_server.calls.worker_process import WorkerLimits
    from vehanchor_server.parts import Parts

_ENDS_WITHIN_S = 5.0  # a killed process, unless the system is stuck
_POLL_S = 0.05  # interval at which a waiting thread checks for a stop request
_logger = logging.getLogger(__name__)


class WorkerFailedError(Exception):
    """A bug in a worker; the message is its traceback."""


class WorkerPool:
    """Workers of a server, at most one per concurrent call.

    Args:
        make_services: creates a worker's parts: a module-level function or a ``functools.partial`` of one.
        limits: resource limits of each worker.

    Attributes:
        make_services: as given.
        limits: as given.
        closed: whether all workers were ended.
        failure: error code of the last failed load of the models, or None.
    """

    def __init__(self, make_services: Callable[[], Parts], limits: WorkerLimits) -> None:
        self.make_services = make_services
        self.limits = limits
        self.closed = False
        self.failure: str | None = None
        self._lock = threading.Lock()
        self._workers = [_Worker(self)]  # all that have not ended
        self._idle = list(self._workers)
        self._logged: set[str] = set()

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self.failure is None and any(worker.loaded for worker in tuple(self._workers))

    @property
    def processes(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in tuple(self._workers) if worker.process and worker.process.pid]

    def log_once(self, level: int, text: str) -> None:
        """Log a message that all workers share once."""
        if text not in self._logged:
            self._logged.add(text)
            _logger.log(level, text)

    def start(self, delay_s: float = 0.0) -> None:
        """Start the first worker in the background after a delay."""
        timer = threading.Timer(delay_s, self._workers[0].start)
        timer.name, timer.daemon = "vehanchor-workers", True
        timer.start()

    def run(self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]) -> Reply[Record]:
        """Run a task in a worker; blocks, so call it in a thread.

        Args:
            task: the task.
            stop: kills the worker on request.
            report: receives progress.

        Raises:
            CallError: ``worker_killed``, ``worker_unavailable``, or the failure of the work.
            CallStoppedError: a stop was requested.
            WorkerFailedError: a bug in the worker.
        """
        worker = self._take(stop)
        try:
            return worker.run(task, stop, report)
        finally:
            if worker.usable:
                self._put(worker)
            else:
                self._end(worker)
                successor = self._new()
                successor.start()
                self._put(successor)

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
        """Take an idle worker and wait for its models; start another one if the system kills it meanwhile.

        Raises:
            CallError: no process starts.
            CallStoppedError: a stop was requested; loading continues.
        """
        for _ in range(2):
            with self._lock:
                ended = [each for each in self._idle if each.has_failed]
                self._idle = [each for each in self._idle if each not in ended]
                worker = max(self._idle, key=lambda each: (each.loaded, each.process is not None), default=None)
                if worker is not None:
                    self._idle.remove(worker)
            for each in ended:
                self._end(each)
            worker = worker or self._new()
            try:
                worker.start()
                worker.await_loaded(stop)
            except CallStoppedError:  # loading continues
                self._put(worker)
                raise
            except Exception:  # no thread, for example
                self._end(worker)
                raise
            if worker.usable:
                return worker
            self._end(worker)
            if not worker.was_killed or self.closed:
                break
        raise CallError(
            "worker_unavailable",
            "this server's worker process does not start; the image is not the cause. Try again in a while; if that "
            "does not help, its operator must check the server's log.",
        )

    def _new(self) -> _Worker:
        worker = _Worker(self)
        with self._lock:
            self._workers.append(worker)
        return worker

    def _put(self, worker: _Worker) -> None:
        with self._lock:
            self._idle.append(worker)

    def _end(self, worker: _Worker) -> None:
        with self._lock:
            self._workers.remove(worker)
        worker.end()


class _Worker:
    """One worker: a process that is started once."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._lock = threading.Lock()
        self._settled = threading.Event()  # its models are loaded, or it has failed
        self._waits = self._killed = False
        self._connection: Connection | None = None
        self.process: BaseProcess | None = None
        self.loaded = False

    @property
    def usable(self) -> bool:
        """Whether the process waits for a task."""
        return self._waits and not self._killed and self.process is not None and self.process.is_alive()

    @property
    def has_failed(self) -> bool:
        """Whether it will run no task any more."""
        return self._settled.is_set() and not self.usable

    @property
    def was_killed(self) -> bool:
        """Whether a signal ended the process."""
        return self.process is not None and (self.process.exitcode or 0) < 0

    def start(self) -> None:
        """Start the process, once."""
        with self._lock:
            if self.process is not None or self._settled.is_set() or self._pool.closed:
                return
            context = _start_context()
            self._connection, theirs = context.Pipe()
            log, written = context.Pipe(duplex=False)
            process = context.Process(
                target=serve_tasks,
                args=(theirs, written, self._pool.make_services, self._pool.limits),
                name="vehanchor-worker",
                daemon=True,
            )
            try:
                with minimal_environment():
                    process.start()
            except (OSError, EOFError) as error:  # no memory, no free process, or a missing fork server
                log.close()
                self._fail(f"no process can be started: {error!r}")
                return
            finally:
                theirs.close()
                written.close()
            forward_log(log, process.pid or 0)
            self.process = process
            if self._pool.closed:
                self.kill()
        threading.Thread(target=self._load, name="vehanchor-loading", daemon=True).start()

    def kill(self) -> None:
        """Kill the process."""
        self._killed = True
        if self.process is not None:
            self.process.kill()

    def end(self) -> None:
        """Kill the process and release what it held."""
        self.kill()
        if self.process is not None:
            self.process.join(_ENDS_WITHIN_S)
        if self._connection is not None:
            self._connection.close()

    def await_loaded(self, stop: Stop) -> None:
        """Wait until the models are loaded, or the process has failed.

        Raises:
            CallStoppedError: a stop was requested.
        """
        while not self._settled.wait(_POLL_S):
            stop.check()

    def _load(self) -> None:
        """Wait for the worker's first message, in a thread."""
        assert self.process is not None
        assert self._connection is not None
        try:
            message = receive(self._connection)
        except (EOFError, OSError, MessageError):
            self.process.join(_ENDS_WITHIN_S)
            self._fail(f"it ended with exit code {self.process.exitcode} during startup")
            return
        if not isinstance(message, Loaded):
            self._fail(message.traceback if isinstance(message, Failed) else f"it sent {message.kind}")
            return
        self._pool.failure = message.failure
        self._pool.log_once(*_confinement_message(message))
        self.loaded = self._waits = True
        self._settled.set()

    def _fail(self, reason: str) -> None:
        if not self._pool.closed:
            self._pool.failure = "worker_unavailable"
            self._pool.log_once(logging.ERROR, f"a worker cannot start: {reason}")
        self._settled.set()

    def run(self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]) -> Reply[Record]:
        """Run a task; a stop request kills the process.

        Raises:
            CallError: the process ended, or the work failed.
            CallStoppedError: a stop was requested.
            WorkerFailedError: a bug in the worker.
        """
        assert self.process is not None
        assert self._connection is not None
        self._waits = False
        with stop.calling(self.kill):
            stop.check()
            try:
                self._connection.send(task)
                return self._listen(self._connection, task, report)
            except MessageError as error:
                _logger.error("a worker sent an invalid message: %s", error)
                raise self._ended() from error
            except (EOFError, OSError) as error:  # the process ended, or sent too much
                self.kill()  # does not change the exit code of one that ended
                self.process.join(_ENDS_WITHIN_S)
                stop.check()
                _logger.warning("a worker ended during a call: exit code %s", self.process.exitcode)
                raise self._ended() from error

    @staticmethod
    def _ended() -> CallError:
        return CallError(
            WORKER_KILLED,
            "the worker process ended: it used too much memory or time, or crashed. Try again, or send another image.",
        )

    def _listen(
        self, connection: Connection, task: Task[Record], report: Callable[[float, str], None]
    ) -> Reply[Record]:
        while True:
            message = receive(connection)
            match message:
                case Progressed():
                    report(message.percent, message.message)
                case Replied():
                    reply = receive_reply(connection, message, task.work.record)
                    self._waits = True
                    return reply
                case Refused():
                    self._waits = message.code != WORKER_KILLED
                    raise CallError(message.code, message.message)
                case Failed():
                    self._waits = True
                    raise WorkerFailedError(message.traceback)
                case _:
                    raise MessageError(f"{message.kind} during a call")


def _confinement_message(loaded: Loaded) -> tuple[int, str]:
    """Describe the confinement of workers for the log."""
    held = [f"Landlock {loaded.landlock}"] * bool(loaded.landlock) + ["seccomp"] * loaded.seccomp
    text = f"workers are confined by {' and '.join(held)}" if held else "workers are not confined"
    return (logging.WARNING, f"{text} ({loaded.lacks})") if loaded.lacks else (logging.INFO, text)


def _start_context() -> ForkServerContext | SpawnContext:
    """Return the start method: on Linux a fork server with all modules imported, for fast replacement.

    The fork server opens no models, because a fork loses their threads. It needs a directory for its socket.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a read-only file system: spawn instead
            tempfile.gettempdir()
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload([serve_tasks.__module__, "vehanchor_server.services", *SLOW_IMPORTS])
            return context
    return multiprocessing.get_context("spawn")
