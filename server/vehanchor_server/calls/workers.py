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

from vehanchor_server.calls.messages import (
    Answered,
    Broken,
    Entered,
    Exhausted,
    Failed,
    Loaded,
    MessageError,
    Progressed,
    Refused,
    read_answer,
    receive,
    send_task,
)
from vehanchor_server.calls.worker_environment import minimal_environment
from vehanchor_server.calls.worker_log import forward_log
from vehanchor_server.calls.worker_process import serve_tasks
from vehanchor_server.errors import CallError
from vehanchor_server.models import SLOW_IMPORTS

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext, SpawnContext
    from multiprocessing.process import BaseProcess

    from vehanchor_server.calls.answer import Answer
    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.task import Parts, Record, Task
    from vehanchor_server.calls.worker_process import WorkerLimits

_MIB = 1 << 20
_ENDS_WITHIN_S = 5.0  # a killed process, unless the system is stuck
_POLL_S = 0.05  # interval at which a waiting thread checks for a stop request
_logger = logging.getLogger(__name__)


class WorkerFailedError(Exception):
    """A bug in a worker; the message is its traceback."""


class WorkerPool:
    """Workers of a server, at most one per concurrent call.

    Args:
        make_services: creates a worker's parts: a module-level function or a ``functools.partial`` of one.
        n_workers: maximum number of workers.
        limits: resource limits of each worker.

    Attributes:
        closed: whether all workers were ended.
    """

    def __init__(self, make_services: Callable[[], Parts], n_workers: int, limits: WorkerLimits) -> None:
        self._make_services = make_services
        self._limits = limits
        self._workers = [_Worker(self) for _ in range(n_workers)]
        self._lock = threading.Lock()
        self._idle = list(self._workers)
        self.closed = False
        self._logged: set[str] = set()
        self._log_lock = threading.Lock()  # separate: the holder of _lock may log

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        for worker in self._workers:
            worker.poll_loaded()
        return any(worker.loaded and worker.failure is None for worker in self._workers)

    @property
    def failure(self) -> str | None:
        """Error code of a failed load of the models, or None."""
        return next((worker.failure for worker in self._workers if worker.failure), None)

    @property
    def processes(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in self._workers if worker.process and worker.process.pid]

    def log_once(self, level: int, text: str) -> None:
        """Log a message that all workers share once."""
        with self._log_lock:
            if text in self._logged:
                return
            self._logged.add(text)
        _logger.log(level, text)

    def start(self, delay_s: float = 0.0) -> None:
        """Start the first worker in the background after a delay."""

        def start_first() -> None:
            if not self.closed:
                self._workers[0].start()

        timer = threading.Timer(delay_s, start_first)
        timer.name, timer.daemon = "vehanchor-workers", True
        timer.start()

    def run(
        self,
        task: Task[Record],
        stop: Stop,
        report: Callable[[float, str], None],
        enter: Callable[[str], None],
    ) -> Answer[Record]:
        """Run a task in a worker; blocks, so call it in a thread.

        Args:
            task: the task.
            stop: kills the worker on request.
            report: receives progress.
            enter: receives stages.

        Raises:
            CallError: ``worker_killed``, ``worker_unavailable``, or the failure of the work.
            CallStoppedError: a stop was requested.
            WorkerFailedError: a bug in the worker.
        """
        with self._lock:
            worker = max(self._idle, key=_Worker.readiness)  # never empty: admitted calls do not exceed workers
            self._idle.remove(worker)
        try:
            return worker.run(task, stop, report, enter)
        finally:
            if not self.closed:
                worker.renew()
            with self._lock:
                self._idle.append(worker)

    def close(self) -> None:
        """End all workers."""
        self.closed = True
        for worker in self._workers:
            worker.kill()

    def remove_socket(self) -> None:
        """Close the pool and remove the workers' socket, for a process that ends without exit handlers."""
        self.close()
        if self.processes:
            with contextlib.suppress(OSError):  # a read-only file system has none
                shutil.rmtree(multiprocessing.util.get_temp_dir(), ignore_errors=True)


class _Worker:
    """One worker: a process and its successors."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._lock = threading.RLock()
        self._connection: Connection | None = None
        self.process: BaseProcess | None = None
        self.loaded = False
        self.failure: str | None = None
        self._lost = False  # killed or ended during a call, even if the system still counts it as alive

    @property
    def _runs(self) -> bool:
        return self.process is not None and self.process.is_alive() and not self._lost

    def start(self) -> None:
        """Start a process if none runs, or if the models of the running one failed to load."""
        with self._lock:
            if self._runs and not self.failure:
                return
            self.kill()
            self._reap()
            context = _start_context()
            ours, theirs = context.Pipe()
            log, written = context.Pipe(duplex=False)
            process = context.Process(
                target=serve_tasks,
                args=(theirs, written, self._pool._make_services, self._pool._limits),
                name="vehanchor-worker",
            )
            process.daemon = True
            try:
                with minimal_environment():
                    process.start()
            except (OSError, EOFError) as error:  # no memory, no free process, or a missing fork server
                ours.close()
                log.close()
                self._fail(f"no process can be started: {error!r}")
                return
            finally:
                theirs.close()
                written.close()
            forward_log(log, process.pid or 0)
            self.process, self._connection = process, ours

    def kill(self) -> None:
        """Kill the process."""
        process = self.process
        if process is not None:
            process.kill()

    def renew(self) -> None:
        """Replace an ended process; one that never loaded is replaced by the next call."""
        if self.process is not None and not self._runs and self.loaded:
            self.start()

    def readiness(self) -> int:
        """Return 2 for loaded models, 1 for a running process, 0 for none."""
        if not self._runs:
            return 0
        self.poll_loaded()
        return 2 if self.loaded else 1

    def poll_loaded(self) -> None:
        """Check, without blocking, whether the models are loaded."""
        if not self.loaded and self._lock.acquire(blocking=False):
            try:
                with contextlib.suppress(EOFError):
                    self._receive_loaded(0)
            finally:
                self._lock.release()

    def await_loaded(self, stop: Stop) -> None:
        """Wait until the models are loaded.

        Raises:
            CallStoppedError: a stop was requested; loading continues.
            EOFError: the process ended.
        """
        while not self.loaded:
            stop.check()
            with self._lock:
                self._receive_loaded(_POLL_S)

    def _receive_loaded(self, wait_s: float) -> None:
        if self.loaded:
            return
        try:
            if self._connection is None:  # not started
                if self.failure:
                    raise EOFError
                return
            if self._connection.poll(wait_s):
                message, _ = receive(self._connection)
                if not isinstance(message, Loaded):
                    self._fail(message.traceback if isinstance(message, Broken) else f"it sent {message.kind}")
                    raise EOFError
                self.failure = message.failure
                self.loaded = True
                self._pool.log_once(*_confinement_message(message))
        except (EOFError, OSError, MessageError):
            self._fail("")
            raise EOFError from None

    def _fail(self, reason: str) -> None:
        """Record and log that the process failed before its first task."""
        if self.failure is None:
            self.failure = "worker_unavailable"
            if not reason and self.process is not None:
                self.process.join(_ENDS_WITHIN_S)
                reason = f"it ended with exit code {self.process.exitcode} during startup"
            self._pool.log_once(logging.ERROR, f"a worker cannot start: {reason}")

    def run(
        self,
        task: Task[Record],
        stop: Stop,
        report: Callable[[float, str], None],
        enter: Callable[[str], None],
    ) -> Answer[Record]:
        """Run a task.

        Raises:
            CallError: the process ended, or the work failed.
            CallStoppedError: a stop was requested.
            WorkerFailedError: a bug in the worker.
        """
        self._start_and_wait(stop)
        assert self.process is not None
        assert self._connection is not None
        turn = _KillOnStop(self.process, stop)
        try:
            with turn:
                stop.check()
                try:
                    send_task(self._connection, task)
                    return self._listen(self._connection, task, turn, report, enter)
                except MessageError as error:
                    _logger.error("a worker sent an invalid message: %s", error)
                    self.process.kill()
                    raise self._ended() from error
                except (EOFError, OSError) as error:  # a broken pipe: the process ended
                    self.process.join(_ENDS_WITHIN_S)
                    stop.check()
                    raise self._ended() from error
        finally:
            self._lost = turn.killed

    def _start_and_wait(self, stop: Stop) -> None:
        """Start the process and wait for its models; retry once if it is killed from outside.

        Raises:
            CallError: the process does not start.
            CallStoppedError: a stop was requested.
        """
        for last in (False, True):
            stop.check()
            self.start()
            try:
                self.await_loaded(stop)
                return
            except EOFError:
                killed = self.process is not None and (self.process.exitcode or 0) < 0
                if last or not killed or self._pool.closed:
                    break
        raise CallError(
            "worker_unavailable",
            "this server's worker process does not start; the image is not the cause. Try again in a while; if that "
            "does not help, its operator must check the server's log.",
        )

    def _ended(self) -> CallError:
        if self.process is not None:
            self.process.join(_ENDS_WITHIN_S)
            _logger.warning("a worker ended during a call: exit code %s", self.process.exitcode)
        return CallError(
            "worker_killed",
            "the worker process ended: it used too much memory or time, or crashed. Try again, or send another image.",
        )

    def _listen(
        self,
        connection: Connection,
        task: Task[Record],
        turn: _KillOnStop,
        report: Callable[[float, str], None],
        enter: Callable[[str], None],
    ) -> Answer[Record]:
        while True:
            message, parts = receive(connection)
            match message:
                case Progressed():
                    report(message.percent, message.message)
                case Entered():
                    enter(message.stage)
                case Answered():
                    answer = read_answer(message, parts, task)
                    turn.over = True
                    return answer
                case Refused():
                    turn.over = True
                    raise CallError(message.code, message.message)
                case Failed():
                    turn.over = True
                    raise WorkerFailedError(message.traceback)
                case Exhausted():
                    raise CallError(
                        "worker_killed",
                        "the image needs more memory than this server allows. Send a smaller image.",
                    )
                case _:
                    raise MessageError(f"{message.kind} during a call")

    def _reap(self) -> None:
        """Release an ended process."""
        if self.process is not None:
            self.process.join()
            self.process.close()
        if self._connection is not None:
            self._connection.close()
        self.process = self._connection = self.failure = None
        self.loaded = self._lost = False


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


class _KillOnStop:
    """Context manager of one call in a process: a stop request kills the process, but not after the call.

    If the block ends before the process has answered, the state of the process is unknown; it is killed too.

    Attributes:
        over: whether the process has answered and waits for the next call.
        killed: whether the process was killed, or had ended by itself.
    """

    def __init__(self, process: BaseProcess, stop: Stop) -> None:
        self._process = process
        self._lock = threading.Lock()
        self._has_turn = True
        self.killed = False
        self.over = False
        stop.on_request(self._kill)

    def __enter__(self) -> _KillOnStop:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.over:
            self._kill()
        with self._lock:
            self._has_turn = False
        if self.killed:
            self._process.join(_ENDS_WITHIN_S)

    def _kill(self) -> None:
        with self._lock:
            if self._has_turn:
                self.killed = True
                self._process.kill()
