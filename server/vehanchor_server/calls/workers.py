"""Worker processes: decode images and run models where the server can kill them.

A hostile image can crash a decoder, fill the memory, compute for ever, or take over the process
that decodes it. Calls therefore run in worker processes. At the deadline of a call, or if its
caller cancels it, the server kills the worker and starts another. The system limits a worker's
memory and processor time, and its access to files and system calls
(``vehanchor_server.sandbox``). What a worker sends is checked data, never pickled objects
(``messages``).

The life of a worker::

    starting --> waiting <--> running a task
        |           |              |
        +-----------+--------------+--> ended: killed, crashed, or unable to start

A worker starts its process and loads its models once, then waits for tasks. ``WorkerPool`` starts
one worker at first, and another when concurrency reaches a new maximum. It replaces a worker that
ends during a task. The thread of a call sends the task, forwards the progress and receives the
reply; so one call occupies one thread of the server and one worker.

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

_END_TIMEOUT_S = 5.0  # a killed process ends at once, unless the system is stuck
_POLL_S = 0.05  # interval at which a thread that waits for a worker checks for a stop request
_MAX_STARTS = 2  # per call: the system may kill one worker while it loads, for lack of memory
_logger = logging.getLogger(__name__)


class WorkerPool:
    """Workers of a server, at most one per concurrent call.

    Args:
        make_resources: creates the resources of a worker: a module-level function, or a
            ``functools.partial`` of one, because it is pickled.
        limits: limits on the memory and processor time of each worker.

    Attributes:
        closed: whether ``close`` was called; a worker that starts later is killed at once.
        failure: error code of the last failed load of the models, or None.
    """

    def __init__(self, make_resources: Callable[[], Resources], limits: WorkerLimits) -> None:
        self.closed = False
        self.failure: str | None = None
        self._make_resources = make_resources
        self._limits = limits
        # Held where a change of a list depends on its content; an append needs no lock.
        self._lock = threading.RLock()
        self._workers: list[_Worker] = []  # all that have not ended
        self._idle: list[_Worker] = []  # those without a call; some may still be starting
        self._logged: set[str] = set()

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self.failure is None and any(worker.loaded for worker in tuple(self._workers))

    @property
    def processes(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in tuple(self._workers) if worker.process.pid]

    def start(self) -> None:
        """Start the first worker, unless a call has done so."""
        with self._lock:
            if not self._workers and not self.closed:
                self._idle.append(self._start_worker())

    def run(
        self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Run a task in a worker; blocks, so call it in a thread.

        Args:
            task: the task.
            stop: kills the worker on request.
            report: receives percentages and messages.

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
                # Its successor loads the models now, so that the next call need not wait.
                if not self.closed:
                    self._idle.append(self._start_worker())

    def close(self) -> None:
        """End all workers."""
        self.closed = True
        for worker in tuple(self._workers):
            worker.kill()

    def remove_socket(self) -> None:
        """Close the pool and remove the directory of the fork server's socket.

        For a process that ends without exit handlers, which would remove it.
        """
        self.close()
        if self.processes:
            with contextlib.suppress(OSError):  # a read-only file system has none
                shutil.rmtree(multiprocessing.util.get_temp_dir(), ignore_errors=True)

    def _take(self, stop: Stop) -> _Worker:
        """Take an idle worker, or start one, and wait for its models.

        Raises:
            CallError: ``worker_unavailable``.
            CallStoppedError: a stop was requested.
        """
        for _ in range(_MAX_STARTS):
            worker = self._pop_idle()
            if worker is None:
                worker = self._start_worker()
            try:
                worker.await_startup(stop)
            except CallStoppedError:
                self._idle.append(worker)  # it continues to load, for a later call
                raise
            if worker.usable:
                return worker
            self._end(worker)
            # Only a signal, such as the system's against a lack of memory, is worth a second try.
            was_killed = (worker.process.exitcode or 0) < 0
            if not was_killed or self.closed:
                break
        raise CallError(
            "worker_unavailable",
            "this server's worker process does not start; the image is not the cause. Try again "
            "in a while; if that does not help, its operator must check the server's log.",
        )

    def _pop_idle(self) -> _Worker | None:
        """Return an idle worker, if possible one with loaded models; end those that failed."""
        with self._lock:
            for worker in tuple(self._idle):
                if worker.has_failed:
                    self._idle.remove(worker)
                    self._end(worker)
            if not self._idle:
                return None
            worker = max(self._idle, key=lambda worker: worker.loaded)
            self._idle.remove(worker)
            return worker

    def _start_worker(self) -> _Worker:
        worker = _Worker(
            self._make_resources,
            self._limits,
            on_loaded=self._on_loaded,
            on_failed=self._on_failed,
        )
        with self._lock:
            self._workers.append(worker)
        # ``close`` may have run meanwhile, without this worker in the list.
        if self.closed:
            worker.kill()
        return worker

    def _end(self, worker: _Worker) -> None:
        with self._lock:
            self._workers.remove(worker)
        worker.end()

    def _on_loaded(self, message: Loaded) -> None:
        """Note the state of a worker whose startup is complete."""
        self.failure = message.failure
        level, text = _confinement_message(message.confinement)
        self._log_once(level, text)

    def _on_failed(self, reason: str) -> None:
        """Note that a worker failed to start; after ``close`` that is no failure."""
        if not self.closed:
            self.failure = "worker_unavailable"
            self._log_once(logging.ERROR, f"a worker cannot start: {reason}")

    def _log_once(self, level: int, text: str) -> None:
        """Log a message once, because it holds for all workers."""
        if text not in self._logged:
            self._logged.add(text)
            _logger.log(level, text)


class _Worker:
    """One worker process, as the server sees it; the process starts at once.

    The process runs ``serve_tasks``. It first sends ``Loaded``, or ``Refused`` for a bug at the
    start. The server sends it one ``Task`` at a time: a function, its arguments and the caller's
    images, which the worker opens. For each task it sends any number of ``Progressed``, and at
    last ``Replied``, followed by the records, or ``Refused``.

    Args:
        make_resources: creates the resources of the worker.
        limits: limits on its memory and processor time.
        on_loaded: receives the first message of the process, in a thread.
        on_failed: receives the reason if the process cannot start.

    Attributes:
        process: the process; without a process id if the system refused to start it.
        loaded: whether the models were loaded, or tried; their failure is in ``Loaded``.
    """

    def __init__(
        self,
        make_resources: Callable[[], Resources],
        limits: WorkerLimits,
        *,
        on_loaded: Callable[[Loaded], None],
        on_failed: Callable[[str], None],
    ) -> None:
        self._on_loaded = on_loaded
        self._on_failed = on_failed
        self._startup_ended = threading.Event()  # successfully or not
        self._is_waiting = False  # for a task
        self._is_killed = False
        self.loaded = False
        context = _start_context()
        # Messages go both ways. The log is a pipe of its own, for what libraries print.
        self._connection, worker_connection = context.Pipe()
        log_reader, log_writer = context.Pipe(duplex=False)
        self.process = context.Process(
            target=serve_tasks,
            args=(worker_connection, log_writer, make_resources, limits),
            name="vehanchor-worker",
            daemon=True,
        )
        try:
            # The server's copies of the worker's ends are closed, so that the end of the process
            # ends the streams.
            with worker_connection, log_writer, minimal_environment():
                self.process.start()
            forward_log(log_reader, self.process.pid or 0)
            thread = threading.Thread(
                target=self._receive_loaded, name="vehanchor-loading", daemon=True
            )
            thread.start()
        # No memory, process or thread is left, or the fork server is gone.
        except (OSError, EOFError, RuntimeError) as error:
            log_reader.close()
            self._fail(f"no process can be started: {error!r}")

    @property
    def usable(self) -> bool:
        """Whether the process waits for a task."""
        return self._is_waiting and not self._is_killed and self.process.is_alive()

    @property
    def has_failed(self) -> bool:
        """Whether the process has started and cannot run a task any more."""
        return self._startup_ended.is_set() and not self.usable

    def kill(self) -> None:
        """Kill the process."""
        self._is_killed = True
        if self.process.pid is not None:
            self.process.kill()

    def end(self) -> None:
        """Kill the process and release its resources."""
        self.kill()
        if self.process.pid is not None:
            self.process.join(_END_TIMEOUT_S)
        self._connection.close()

    def await_startup(self, stop: Stop) -> None:
        """Wait until the models are loaded or the start has failed.

        Raises:
            CallStoppedError: a stop was requested.
        """
        while not self._startup_ended.wait(_POLL_S):
            stop.check()

    def run(
        self, task: Task[Record], stop: Stop, report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Run a task, as ``WorkerPool.run`` does; a stop request kills the process."""
        self._is_waiting = False
        with stop.on_request(self.kill):
            stop.check()
            try:
                self._connection.send(task)
                return self._receive_reply(task, report)
            # The process ended, or sent bytes that are not a message, or too many.
            except (EOFError, OSError, MessageError) as error:
                self.kill()  # does not change the exit code of a process that has ended
                self.process.join(_END_TIMEOUT_S)
                stop.check()  # a requested stop is not a failure of the worker
                cause: object = f"exit code {self.process.exitcode}"
                if isinstance(error, MessageError):
                    cause = error
                _logger.warning("a worker ended during a call: %s", cause)
                raise CallError(
                    WORKER_KILLED,
                    "the worker process ended: it used too much memory or time, or crashed. Try "
                    "again, or send another image.",
                ) from error

    def _receive_reply(
        self, task: Task[Record], report: Callable[[float, str], None]
    ) -> Reply[Record]:
        """Forward the progress of a task until its reply or its failure arrives."""
        while True:
            message = receive(self._connection)
            match message:
                case Progressed():
                    report(message.percent, message.message)
                case Replied():
                    reply = receive_reply(self._connection, message, task.work.record)
                    self._is_waiting = True
                    return reply
                case Refused():
                    # Out of memory, a worker may be in any state: it gets no other task.
                    self._is_waiting = message.code != WORKER_KILLED
                    if message.code == BUG:
                        raise RuntimeError(f"in a worker: {message.message}")
                    raise CallError(message.code, message.message)
                case _:
                    raise MessageError(f"{message.kind} during a call")

    def _receive_loaded(self) -> None:
        """Wait for the first message of the process, in a thread."""
        try:
            message = receive(self._connection)
        except (EOFError, OSError, MessageError):
            self.process.join(_END_TIMEOUT_S)
            self._fail(f"it ended with exit code {self.process.exitcode} during startup")
            return
        match message:
            case Loaded():
                self._on_loaded(message)
                self.loaded = True
                self._is_waiting = True
                self._startup_ended.set()
            case Refused():
                self._fail(message.message)
            case _:
                self._fail(f"it sent {message.kind}")

    def _fail(self, reason: str) -> None:
        self._on_failed(reason)
        self._startup_ended.set()


def _confinement_message(confinement: Confinement) -> tuple[int, str]:
    """Describe the confinement of workers for the log: level and text."""
    held = []
    if confinement.landlock:
        held.append(f"Landlock {confinement.landlock}")
    if confinement.seccomp:
        held.append("seccomp")
    text = "workers are not confined"
    if held:
        text = f"workers are confined by {' and '.join(held)}"
    if confinement.lacks:
        return logging.WARNING, f"{text} ({confinement.lacks})"
    return logging.INFO, text


def _start_context() -> ForkServerContext | SpawnContext:
    """Return the start method of worker processes.

    On Linux a fork server imports all modules once, and each worker is a fork of it: a killed
    worker is replaced at once. The fork server opens no models, because a fork would lose their
    threads. It needs a directory for its socket; without one, and on other systems, each worker
    is a new interpreter.
    """
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    try:
        tempfile.gettempdir()
    except OSError:  # a read-only file system
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    modules = [serve_tasks.__module__, "vehanchor_server.resources", *SLOW_IMPORTS]
    context.set_forkserver_preload(modules)
    return context
