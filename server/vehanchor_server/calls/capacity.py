"""Places for calls: how much runs at once, for how long, and how it is stopped.

A call has a place from the moment it is accepted until its worker thread has ended, so that what a cancelled call still
computes counts as well. There is no queue: over capacity a call is refused at once, and its caller knows.
"""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import anyio
import anyio.lowlevel
import anyio.to_thread

from vehanchor_server.errors import CallError

T = TypeVar("T")


class CallStoppedError(Exception):
    """Raised in the worker thread of a call that nobody waits for any more."""


class Stop:
    """The request that a call end early; set from the event loop, looked at by the worker thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requested = False
        self._actions: list[Callable[[], None]] = []

    @property
    def requested(self) -> bool:
        """Whether the call was asked to end."""
        return self._requested

    def request(self) -> None:
        """Ask the call to end."""
        with self._lock:
            self._requested = True
            actions, self._actions = self._actions, []
        for action in actions:
            action()

    def check(self) -> None:
        """End here if that was asked for.

        Raises:
            CallStoppedError: it was.
        """
        if self._requested:
            raise CallStoppedError

    def on_request(self, action: Callable[[], None]) -> None:
        """Do this as soon as the call is asked to end; at once if it already was."""
        with self._lock:
            if not self._requested:
                self._actions.append(action)
                return
        action()


@dataclass(frozen=True)
class _Outcome(Generic[T]):
    """The end of a worker thread's work; carried as a value, so that no exception meets a cancellation on the way."""

    value: T | None = None
    error: Exception | None = None


class Capacity:
    """Admits calls, runs their work in threads, and stops it.

    Args:
        max_concurrency: calls at once.
        deadline_s: seconds after which a call ends.
    """

    def __init__(self, max_concurrency: int, deadline_s: float) -> None:
        self.max_concurrency = max_concurrency
        self.deadline_s = deadline_s
        self._stops: set[Stop] = set()
        self._closed = False
        self._limiter: anyio.CapacityLimiter | None = None

    @property
    def running(self) -> int:
        """Calls that have a place now."""
        return len(self._stops)

    async def run(self, call: Callable[[Stop], Awaitable[T]]) -> T:
        """Run a call, if there is a place for it.

        Args:
            call: gets the ``Stop`` to pass on to ``in_thread``.

        Raises:
            CallError: ``busy``, ``deadline_exceeded`` or ``server_stopping``.
        """
        if self._closed:
            raise CallError("server_stopping", "the server is shutting down. Try again in a while.")
        if self.running >= self.max_concurrency:
            raise CallError(
                "busy", f"all {self.max_concurrency} places of this server are taken. Try again in a few seconds."
            )
        stop = Stop()
        self._stops.add(stop)
        try:
            with anyio.move_on_after(self.deadline_s):
                return await call(stop)
        finally:
            self._stops.discard(stop)
        raise CallError(
            "deadline_exceeded",
            f"the call took longer than {self.deadline_s:g} s. Send a smaller image, or fewer, or try again later.",
        )

    async def in_thread(self, stop: Stop, work: Callable[[], T]) -> T:
        """Run blocking work in a thread; a cancellation requests the stop at once and waits until the thread has ended.

        Raises:
            CallError: ``server_stopping``, if the work was stopped by ``close``.
        """
        if self._limiter is None:  # belongs to the event loop, which is not there yet when this object is made
            self._limiter = anyio.CapacityLimiter(self.max_concurrency)

        ended = threading.Event()

        def guarded() -> _Outcome[T]:
            try:
                return _Outcome(value=work())
            except Exception as error:
                return _Outcome(error=error)
            finally:
                ended.set()

        async with anyio.create_task_group() as group:
            group.start_soon(_request_when_cancelled, stop, ended)
            outcome = await anyio.to_thread.run_sync(guarded, limiter=self._limiter)
            group.cancel_scope.cancel()
        await anyio.lowlevel.checkpoint_if_cancelled()
        if outcome.error is not None and stop.requested:  # CallStoppedError, or whatever a terminated model raises
            raise CallError("server_stopping", "the server is shutting down. Try again in a while.")
        if outcome.error is not None:
            raise outcome.error
        return outcome.value  # type: ignore[return-value] # there is one where there is no error

    def close(self) -> None:
        """Accept no more calls, and stop those that run."""
        self._closed = True
        for stop in list(self._stops):
            stop.request()


async def _request_when_cancelled(stop: Stop, ended: threading.Event) -> None:
    try:
        await anyio.sleep_forever()
    finally:
        if not ended.is_set():
            stop.request()
