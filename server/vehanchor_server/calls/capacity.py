"""Capacity: limits on concurrent calls and their duration, and stopping of calls.

A call occupies a slot from its admission until its thread ends, so that the remaining work of a
cancelled call counts. Beyond the capacity, calls wait for some seconds, because hosts call tools in
parallel. The queue is short: a few calls for each client. A free slot goes to the client that has
the fewest.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple, TypeVar

import anyio
import anyio.lowlevel
import anyio.to_thread

from vehanchor.models.runtime import Cancellation
from vehanchor_server.errors import CallError

T = TypeVar("T")

MAX_WAIT_S = 10.0
"""Longest wait for a slot, and at most half of the deadline. A choice."""

MAX_WAITING = 32
"""Maximum number of waiting calls. A choice."""

MAX_WAITING_PER_CLIENT = 8
"""Maximum number of waiting calls of one client: hosts call a few tools in parallel. A choice."""


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


class _Waiting(NamedTuple):
    """Call that waits for a slot.

    Attributes:
        client: its client.
        ended: set when the wait ends: a slot is its own, or the server stops.
    """

    client: str
    ended: anyio.Event


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
        self._slots: Counter[str] = Counter()
        self._waiting: list[_Waiting] = []
        self._closed = False

    @property
    def running(self) -> int:
        """Number of running calls."""
        return len(self._stops)

    async def run(self, call: Callable[[Stop], Awaitable[T]], client: str = "") -> T:
        """Run a call within the capacity; the deadline includes the wait for a slot.

        Args:
            call: receives the ``Stop`` for ``in_thread``.
            client: name of the client; calls of one name share their turn.

        Raises:
            CallError: ``busy``, ``deadline_exceeded`` or ``server_stopping``.
        """
        if self._closed:
            raise _server_stopping()
        with anyio.move_on_after(self.deadline_s):
            await self._enter(client)
            stop = Stop()
            self._stops.add(stop)
            try:
                return await call(stop)
            finally:
                self._stops.discard(stop)
                self._leave(client)
        raise CallError(
            "deadline_exceeded",
            f"the call took longer than {self.deadline_s:g} s. Send a smaller image, or fewer, "
            "or try again later.",
        )

    async def _enter(self, client: str) -> None:
        """Take a slot, or wait for one.

        Raises:
            CallError: ``busy`` or ``server_stopping``.
        """
        if self._slots.total() < self.max_concurrency:
            self._slots[client] += 1
            return
        n_of_client = sum(waiting.client == client for waiting in self._waiting)
        if len(self._waiting) >= MAX_WAITING or n_of_client >= MAX_WAITING_PER_CLIENT:
            raise self._busy()
        waiting = _Waiting(client, anyio.Event())
        self._waiting.append(waiting)
        try:
            with anyio.move_on_after(min(MAX_WAIT_S, self.deadline_s / 2)):
                await waiting.ended.wait()
        except anyio.get_cancelled_exc_class():
            self._give_up(waiting)
            raise
        if self._closed:
            self._give_up(waiting)
            raise _server_stopping()
        if waiting in self._waiting:
            self._give_up(waiting)
            raise self._busy()

    def _give_up(self, waiting: _Waiting) -> None:
        """End a wait; a slot that was handed over at the same moment is given back."""
        if waiting in self._waiting:
            self._waiting.remove(waiting)
        else:
            self._leave(waiting.client)

    def _leave(self, client: str) -> None:
        """Give a slot back, or hand it to the waiting client with the fewest slots."""
        self._slots[client] -= 1
        if not self._waiting:
            return
        # The earliest of equals is first.
        following = min(self._waiting, key=self._slots_of_client)
        self._waiting.remove(following)
        self._slots[following.client] += 1
        following.ended.set()

    def _slots_of_client(self, waiting: _Waiting) -> int:
        return self._slots[waiting.client]

    def _busy(self) -> CallError:
        return CallError(
            "busy",
            f"all {self.max_concurrency} slots of this server are taken, and so is the queue. Try "
            "again in a few seconds.",
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
        """Refuse new calls, and stop the running and the waiting ones."""
        self._closed = True
        for waiting in self._waiting:
            waiting.ended.set()
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
