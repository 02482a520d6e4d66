"""Processes in which images are decoded and models run, so that whatever an image does can be ended.

Each has its models loaded and waits for a call; a thread of the server sends it one and passes on what it reports. At
the deadline, and when nobody waits any more, it is killed, and the next one is started at once. Its memory and
processor time are limited by the system besides, and so is what it may read, write and ask for (``confinement``). One
is started with the server, another whenever more calls than ever before run at once; after a call each gives the memory
back that it no longer needs. The processes and their pipes are those of the standard library's ``multiprocessing``.
No pool was found that fits: ``anyio.to_process`` kills, but has no way for progress and swallows what a worker logs;
``concurrent.futures`` and ``loky`` break the whole pool with one killed worker; ``pebble`` is under the LGPL.
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
_LOOKS_S = 0.05  # how often a thread that waits for a worker to be ready looks whether it still shall
_logger = logging.getLogger(__name__)


class WorkerFailedError(Exception):
    """A bug in a worker; its message is the traceback there."""


class WorkerPool:
    """The workers of a server, at most one for each call that may run at once.

    Args:
        make_services: makes a worker's parts; a function of a module, or a ``functools.partial`` of one.
        n_workers: how many at most.
        limits: what each may use.

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
        self._said: set[str] = set()
        self._saying = threading.Lock()  # not the other: who chooses a worker holds that, and may be told of its start

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        for worker in self._workers:
            worker.look()
        return any(worker.loaded and worker.failure is None for worker in self._workers)

    @property
    def failure(self) -> str | None:
        """The code of the error that loading the models ended with, None without one."""
        return next((worker.failure for worker in self._workers if worker.failure), None)

    @property
    def processes(self) -> list[int]:
        """The processes' numbers."""
        return [worker.process.pid for worker in self._workers if worker.process and worker.process.pid]

    def say_once(self, level: int, text: str) -> None:
        """Log what every worker meets alike."""
        with self._saying:
            if text in self._said:
                return
            self._said.add(text)
        _logger.log(level, text)

    def start(self, delay_s: float = 0.0) -> None:
        """Start the first, in the background, after a while."""

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
        """Have a task done by a worker; blocks, and is called in a thread.

        Args:
            task: the task.
            stop: kills the worker when it is requested.
            report: gets the progress.
            enter: gets the stages.

        Raises:
            CallError: ``worker_killed``, ``worker_unavailable``, or why the work failed.
            CallStoppedError: the stop was requested.
            WorkerFailedError: a bug.
        """
        with self._lock:
            worker = max(self._idle, key=_Worker.warmth)  # there is one: as many calls as workers are admitted
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

    def leave_nothing(self) -> None:
        """Remove the workers' socket, for a process that ends without its exit handlers; no worker starts after it."""
        self.close()
        if self.processes:
            with contextlib.suppress(OSError):  # on a read-only file system there is none
                shutil.rmtree(multiprocessing.util.get_temp_dir(), ignore_errors=True)


class _Worker:
    """One process, and the next after it."""

    def __init__(self, pool: WorkerPool) -> None:
        self._pool = pool
        self._lock = threading.RLock()
        self._connection: Connection | None = None
        self.process: BaseProcess | None = None
        self.loaded = False
        self.failure: str | None = None

    def start(self) -> None:
        """Start a process, if none runs, or one whose models failed, and which cannot see what has come since."""
        with self._lock:
            if self.process is not None and self.process.is_alive():
                if not self.failure:
                    return
                self.process.kill()
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
            except (OSError, EOFError) as error:  # no memory, no process left, or the one that it comes from is gone
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
        """Start the next process after one that ended; one that never loaded is not started again before a call."""
        if self.process is not None and not self.process.is_alive() and self.loaded:
            self.start()

    def warmth(self) -> int:
        """How soon it can work: 2 at once, 1 when its models are loaded, 0 when it was started before that."""
        process = self.process
        if process is None or not process.is_alive():
            return 0
        self.look()
        return 2 if self.loaded else 1

    def look(self) -> None:
        """See whether the models are loaded by now; never blocks."""
        if not self.loaded and self._lock.acquire(blocking=False):
            try:
                with contextlib.suppress(EOFError):
                    self._receive_loaded(0)
            finally:
                self._lock.release()

    def await_loaded(self, stop: Stop) -> None:
        """Wait until the models are loaded.

        Raises:
            CallStoppedError: the stop was requested; the process goes on loading.
            EOFError: the process ended.
        """
        while not self.loaded:
            stop.check()
            with self._lock:
                self._receive_loaded(_LOOKS_S)

    def _receive_loaded(self, wait_s: float) -> None:
        if self.loaded:
            return
        try:
            if self._connection is None:  # it was not started, or could not be
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
                self._pool.say_once(*_told(message))
        except (EOFError, OSError, MessageError):
            self._fail("")
            raise EOFError from None

    def _fail(self, reason: str) -> None:
        """Remember that the process never got as far as to work, and log why."""
        if self.failure is None:
            self.failure = "worker_unavailable"
            if not reason and self.process is not None:
                self.process.join(_ENDS_WITHIN_S)
                reason = f"it ended with exit code {self.process.exitcode} before it could work"
            self._pool.say_once(logging.ERROR, f"a worker cannot start: {reason}")

    def run(
        self,
        task: Task[Record],
        stop: Stop,
        report: Callable[[float, str], None],
        enter: Callable[[str], None],
    ) -> Answer[Record]:
        """Have a task done.

        Raises:
            CallError: the process ended, or the work failed.
            CallStoppedError: the stop was requested.
            WorkerFailedError: a bug.
        """
        self._start_and_wait(stop)
        assert self.process is not None
        assert self._connection is not None
        with _KilledOnRequest(self.process, stop) as turn:
            stop.check()
            try:
                send_task(self._connection, task)
                result = self._listen(self._connection, task, turn, report, enter)
            except MessageError as error:
                _logger.error("a worker sent what none sends: %s", error)
                self.process.kill()
                raise self._ended() from error
            except (EOFError, OSError) as error:  # the pipe broke: the process ended
                self.process.join(_ENDS_WITHIN_S)
                stop.check()
                raise self._ended() from error
        return result

    def _start_and_wait(self, stop: Stop) -> None:
        """Have a process that works; one that is killed from outside before it does is started once more.

        Raises:
            CallError: there is none.
            CallStoppedError: the stop was requested.
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
            "this server's process for work on images does not start; the image is not to blame. Try again in a while; "
            "if that does not help, its operator must look at the server's log.",
        )

    def _ended(self) -> CallError:
        if self.process is not None:
            self.process.join(_ENDS_WITHIN_S)
            _logger.warning("a worker ended during a call: exit code %s", self.process.exitcode)
        return CallError(
            "worker_killed",
            "the process that worked on the image ended: it took too much memory or time, or crashed. Try again, "
            "or send another image.",
        )

    def _listen(
        self,
        connection: Connection,
        task: Task[Record],
        turn: _KilledOnRequest,
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
                        "the work on the image took more memory than this server allows. Send a smaller image.",
                    )
                case _:
                    raise MessageError(f"{message.kind} during a call")

    def _reap(self) -> None:
        """Forget the process that ended."""
        if self.process is not None:
            self.process.join()
            self.process.close()
        if self._connection is not None:
            self._connection.close()
        self.process = self._connection = self.failure = None
        self.loaded = False


def _told(loaded: Loaded) -> tuple[int, str]:
    """How workers are confined, for the log."""
    held = [f"Landlock {loaded.landlock}"] * bool(loaded.landlock) + ["seccomp"] * loaded.seccomp
    told = f"workers are confined by {' and '.join(held)}" if held else "workers are not confined"
    return (logging.WARNING, f"{told} ({loaded.lacks})") if loaded.lacks else (logging.INFO, told)


def _start_context() -> ForkServerContext | SpawnContext:
    """How processes start: on Linux from one that has imported everything, so that a killed one is soon replaced.

    That one opens no model, as sessions have threads, which a fork would lose; and it needs a place for its socket.
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # a read-only file system: each process imports for itself
            tempfile.gettempdir()
            context = multiprocessing.get_context("forkserver")
            context.set_forkserver_preload([serve_tasks.__module__, "vehanchor_server.services", *SLOW_IMPORTS])
            return context
    return multiprocessing.get_context("spawn")


class _KilledOnRequest:
    """One call's turn with a process: a context manager in which a stop request kills it, and after which none does.

    A turn that ends before its call is over leaves a process that nobody knows the state of: it is killed, too.

    Attributes:
        over: whether the process has answered, and waits for the next call.
    """

    def __init__(self, process: BaseProcess, stop: Stop) -> None:
        self._process = process
        self._lock = threading.Lock()
        self._has_turn = True
        self._killed = False
        self.over = False
        stop.on_request(self._kill)

    def __enter__(self) -> _KilledOnRequest:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.over:
            self._kill()
        with self._lock:
            self._has_turn = False
        if self._killed:
            self._process.join(_ENDS_WITHIN_S)

    def _kill(self) -> None:
        with self._lock:
            if self._has_turn:
                self._killed = True
                self._process.kill()
