"""Capacity: limits on concurrent calls and their duration, and stopping of calls.

A call occupies a slot from its admission until its thread ends, so that the remaining work of a
cancelled call counts. There is no queue: beyond the capacity, calls are refused at once.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

import anyio
import anyio.lowlevel
import anyio.to_thread

from vehanchor.models.runtime import Cancellation
from vehanchor_server.errors import CallError

T = TypeVar("T")


class CallStoppedError(Exception):
    """Raised in the thread of a call that was stopped."""


class Stop(Cancellation):
    """Stop of a call: the event loop requests it, and the call's thread obeys.

    The thread checks for it between tiles, a running model ends within a layer, and a worker is
    killed by an action.
    """

    def __init__(self) -> None:
        super().__init__()
        self._actions: list[Callable[[], None]] = []

    def cancel(self) -> None:
        """Request the stop: end running models and do the actions, once."""
        super().cancel()
        with self._lock:
            while self._actions:
                self._actions.pop()()

    def check(self) -> None:
        """Raise if a stop was requested.

        Raises:
            CallStoppedError: a stop was requested.
        """
        if self.requested:
            raise CallStoppedError

    @contextmanager
    def on_request(self, action: Callable[[], None]) -> Iterator[None]:
        """Do an action if a stop is requested within the context, or was before; never after it."""
        with self._lock:
            if self.requested:
                action()
            else:
                self._actions.append(action)
        try:
            yield
        finally:
            with self._lock, suppress(ValueError):  # the action was done
                self._actions.remove(action)


class Capacity:
    """Admission of calls, their threads and their deadline.

    Args:
        max_concurrency: maximum number of concurrent calls.
        deadline_s: seconds after which a call ends.
    """

    def __init__(self, max_concurrency: int, deadline_s: float) -> None:
        self.max_concurrency = max_concurrency
        self.deadline_s = deadline_s
        self._stops: set[Stop] = set()
        self._closed = False

    @property
    def running(self) -> int:
        """Number of running calls."""
        return len(self._stops)

    async def run(self, call: Callable[[Stop], Awaitable[T]]) -> T:
        """Run a call within the capacity.

        Args:
            call: receives the ``Stop`` for ``in_thread``.

        Raises:
            CallError: ``busy``, ``deadline_exceeded`` or ``server_stopping``.
        """
        if self._closed:
            raise _server_stopping()
        if self.running >= self.max_concurrency:
            raise CallError(
                "busy",
                f"all {self.max_concurrency} slots of this server are taken. Try again in a few "
                "seconds.",
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
            f"the call took longer than {self.deadline_s:g} s. Send a smaller image, or fewer, "
            "or try again later.",
        )

    async def in_thread(self, stop: Stop, work: Callable[[], T]) -> T:
        """Run blocking work in a thread; a cancellation requests the stop and waits for the thread.

        Raises:
            CallError: ``server_stopping``, if the work was stopped by ``close``.
        """

        # The error is a value: raised in the task group, it could collide with a cancellation.
        def guarded() -> tuple[T | None, Exception | None]:
            try:
                return work(), None
            except Exception as error:
                return None, error

        async with anyio.create_task_group() as group:
            group.start_soon(_request_when_cancelled, stop)
            value, error = await anyio.to_thread.run_sync(guarded, limiter=anyio.CapacityLimiter(1))
            was_stopped = stop.requested
            group.cancel_scope.cancel()
        await anyio.lowlevel.checkpoint_if_cancelled()
        if error is None:
            return value  # type: ignore[return-value] # without an error there is a value
        # A stop of a call that was not cancelled came from ``close``. The error is then
        # CallStoppedError, or that of a terminated model.
        if was_stopped:
            raise _server_stopping()
        raise error

    def close(self) -> None:
        """Refuse new calls and stop the running ones."""
        self._closed = True
        for stop in list(self._stops):
            stop.cancel()


def _server_stopping() -> CallError:
    return CallError("server_stopping", "the server is shutting down. Try again in a while.")


async def _request_when_cancelled(stop: Stop) -> None:
    """Request the stop when this task is cancelled: with its call, or after the work."""
    try:
        await anyio.sleep_forever()
    finally:
        stop.cancel()  # without effect after the work
