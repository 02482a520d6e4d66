"""Process of its own for images that may end the process that reads them.

A damaged image can crash a decoder, and the system ends a process that takes too much memory.
Neither raises an exception.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from vehanchor.analysis.heap import huge_pages_in_new_processes
from vehanchor.errors import VehAnchorError, WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Callable
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess

Input = TypeVar("Input")
Output = TypeVar("Output")
Report: TypeAlias = "Callable[..., None]"
"""Receives the progress of the work, whatever its arguments are."""

_READY = "ready"
_REPORTED = "reported"
_DONE = "done"
_RAISED = "raised"
_CRASHED = (
    "this image ended the process that read it: its decoder crashed, or took too much memory. Save "
    "it again in another format"
)
_NOT_STARTED = (
    "a worker process died before it had an image, usually for lack of memory: it holds a model "
    "and an image"
)


class _EndedError(Exception):
    """The process ended."""


class IsolatedProcess(Generic[Input, Output]):
    """Process that works on one input at a time, and is replaced after an input has ended it.

    Args:
        prepare: prepares the process, and returns the function that does the work; it is pickled,
            so it is a module-level function or a ``functools.partial`` of one.
        remedy: what to do if the process cannot start, as sentences.
    """

    def __init__(
        self, prepare: Callable[[], Callable[[Input, Report], Output]], remedy: str
    ) -> None:
        self._prepare = prepare
        self._remedy = remedy
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None

    def start(self) -> None:
        """Start the process, unless it runs.

        Raises:
            WorkerDiedError: the process died before it was ready.
            VehAnchorError: what ``prepare`` raised.
            RuntimeError: a defect in ``prepare``.
        """
        if self._process is not None:
            return
        # A forked copy of a process with threads can deadlock, so the process starts anew.
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._prepare), daemon=True)
        self._connection = ours
        with huge_pages_in_new_processes():
            self._process.start()
        # The end of the process then ends the connection.
        theirs.close()
        try:
            self._receive(report=None)
        except _EndedError:
            self.close()
            raise WorkerDiedError(f"{_NOT_STARTED}. {self._remedy}") from None
        except BaseException:
            self.close()
            raise

    def run(self, work: Input, report: Report | None = None) -> Output:
        """Work on one input.

        Args:
            work: the input, which is pickled.
            report: receives the progress, in this process; None ignores it.

        Raises:
            WorkerDiedError: the input ended the process, or the process died before it was ready.
            VehAnchorError: what the work raised.
            RuntimeError: a defect in the work.
        """
        self.start()
        assert self._connection is not None
        try:
            # A process that has ended meanwhile is noticed when its answer is received.
            with contextlib.suppress(ConnectionError):
                self._connection.send(work)
            output: Output = self._receive(report)
        except _EndedError:
            self.close()
            raise WorkerDiedError(_CRASHED) from None
        return output

    def _receive(self, report: Report | None) -> Any:
        """Receive messages until the work is done.

        Raises:
            _EndedError: the process ended, perhaps during a message.
        """
        assert self._connection is not None
        while True:
            try:
                kind, content = self._connection.recv()
            except (EOFError, OSError):
                raise _EndedError from None
            if kind == _RAISED:
                raise content
            if kind != _REPORTED:
                return content
            if report is not None:
                report(*content)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
        if self._connection is not None:
            self._connection.close()
        self._process = None
        self._connection = None


def _serve(
    connection: Connection, prepare: Callable[[], Callable[[Input, Report], Output]]
) -> None:
    """Work on inputs until the other process closes the connection."""
    ignore_interrupts_and_end_with_parent()

    def report(*progress: object) -> None:
        connection.send((_REPORTED, progress))

    # The other process may end at any time.
    with contextlib.suppress(EOFError, ConnectionError):
        try:
            work_on = prepare()
        except Exception as error:
            connection.send((_RAISED, _sendable(error)))
            return
        connection.send((_READY, None))
        while True:
            work = connection.recv()
            message: tuple[str, object]
            try:
                message = (_DONE, work_on(work, report))
            except Exception as error:
                message = (_RAISED, _sendable(error))
            connection.send(message)


def _sendable(error: Exception) -> Exception:
    """Replace an exception of other libraries: some cannot be pickled."""
    if isinstance(error, VehAnchorError):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}")


def ignore_interrupts_and_end_with_parent() -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the parent; end with it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
