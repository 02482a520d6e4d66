"""Slots of calls, whatever the calls do."""

from __future__ import annotations

import threading
import time

import anyio
import pytest

from vehanchor_server.calls.capacity import (
    MAX_WAITING,
    MAX_WAITING_PER_CLIENT,
    Capacity,
    Stop,
)
from vehanchor_server.errors import CallError

pytestmark = pytest.mark.anyio


def work_until_stopped(stop: Stop) -> None:
    while True:
        stop.check()
        time.sleep(0.005)


@pytest.fixture
def no_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call beyond the capacity waits for a moment only."""
    monkeypatch.setattr("vehanchor_server.calls.capacity.MAX_WAIT_S", 0.01)


@pytest.mark.usefixtures("no_wait")
async def test_a_slot_is_taken_until_the_thread_has_ended() -> None:
    capacity = Capacity(1, 60)
    began = threading.Event()
    release = threading.Event()

    def work() -> None:  # does not listen to stop requests
        began.set()
        release.wait()

    async with anyio.create_task_group() as group:

        async def deaf() -> None:
            await capacity.run(lambda stop: capacity.in_thread(stop, work))

        group.start_soon(deaf)
        while not began.is_set():
            await anyio.sleep(0.001)
        group.cancel_scope.cancel()
        with anyio.CancelScope(shield=True):
            await anyio.sleep(0.05)
            assert capacity.running == 1
            with pytest.raises(CallError, match="busy"):
                await capacity.run(lambda stop: capacity.in_thread(stop, lambda: None))
            release.set()
    assert capacity.running == 0


async def test_whatever_stopped_work_raises_ends_in_the_cancellation() -> None:
    capacity = Capacity(1, 0.1)

    def terminated(stop: Stop) -> None:
        while not stop.requested:
            time.sleep(0.005)
        raise RuntimeError("Exiting due to terminate flag being set to true.")

    with pytest.raises(CallError, match="deadline_exceeded"):
        await capacity.run(lambda stop: capacity.in_thread(stop, lambda: terminated(stop)))


async def test_closing_refuses_running_calls_like_later_ones() -> None:
    capacity = Capacity(2, 60)
    codes: list[str] = []

    async def call() -> None:
        try:
            await capacity.run(
                lambda stop: capacity.in_thread(stop, lambda: work_until_stopped(stop))
            )
        except CallError as error:
            codes.append(error.code)

    async with anyio.create_task_group() as group:
        group.start_soon(call)
        while not capacity.running:
            await anyio.sleep(0.001)
        capacity.close()
    await call()
    assert codes == ["server_stopping", "server_stopping"]


async def test_the_deadline_counts_before_the_thread_as_well() -> None:
    capacity = Capacity(1, 0.1)
    with pytest.raises(CallError, match="deadline_exceeded"):
        await capacity.run(lambda _: anyio.sleep(5))


class Crowd:
    """Calls of several clients on one slot; each call ends when the test lets it.

    Attributes:
        capacity: one slot.
        order: clients of the calls in the order of their starts.
        refused: codes of refused calls.
    """

    def __init__(self) -> None:
        self.capacity = Capacity(1, 60)
        self.order: list[str] = []
        self.refused: list[str] = []
        self._let_go = anyio.Semaphore(0)

    async def call(self, client: str) -> None:
        """Call, and wait for permission to end."""

        async def work(_: Stop) -> None:
            self.order.append(client)
            await self._let_go.acquire()

        try:
            await self.capacity.run(work, client)
        except CallError as error:
            self.refused.append(error.code)

    async def end_one(self) -> None:
        """Let the running call end, and the next one start."""
        self._let_go.release()
        await anyio.wait_all_tasks_blocked()


async def test_parallel_calls_of_a_client_wait_for_their_turn() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        for _ in range(6):
            group.start_soon(crowd.call, "host")
        for _ in range(6):
            await anyio.wait_all_tasks_blocked()
            assert crowd.capacity.running == 1
            await crowd.end_one()
    assert crowd.order == ["host"] * 6
    assert crowd.refused == []


async def test_a_client_with_fewer_slots_goes_first() -> None:
    crowd = Crowd()
    crowd.capacity.max_concurrency = 2
    async with anyio.create_task_group() as group:
        for client in ("host", "host", "host", "guest"):
            group.start_soon(crowd.call, client)
            await anyio.wait_all_tasks_blocked()
        for _ in range(4):
            await crowd.end_one()
    assert crowd.order == ["host", "host", "guest", "host"]


async def test_a_client_may_not_fill_the_queue() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        for _ in range(MAX_WAITING_PER_CLIENT + 4):
            group.start_soon(crowd.call, "host")
        await anyio.wait_all_tasks_blocked()
        assert crowd.refused == ["busy"] * 3
        for _ in range(MAX_WAITING_PER_CLIENT + 1):
            await crowd.end_one()
    assert len(crowd.order) == MAX_WAITING_PER_CLIENT + 1


async def test_the_queue_is_short() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        for number in range(MAX_WAITING + 5):
            group.start_soon(crowd.call, f"host {number}")
        await anyio.wait_all_tasks_blocked()
        assert crowd.refused == ["busy"] * 4
        group.cancel_scope.cancel()


@pytest.mark.usefixtures("no_wait")
async def test_a_call_that_waits_too_long_is_refused() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        group.start_soon(crowd.call, "host")
        await anyio.wait_all_tasks_blocked()
        await crowd.call("host")
        await crowd.end_one()
    assert crowd.refused == ["busy"]


async def test_a_cancelled_wait_leaves_the_queue() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        group.start_soon(crowd.call, "host")
        await anyio.wait_all_tasks_blocked()
        with anyio.move_on_after(0.01):
            await crowd.call("impatient")
        group.start_soon(crowd.call, "patient")
        await anyio.wait_all_tasks_blocked()
        await crowd.end_one()
        await crowd.end_one()
    assert crowd.order == ["host", "patient"]
    assert crowd.capacity.running == 0


async def test_closing_ends_all_waits() -> None:
    crowd = Crowd()
    async with anyio.create_task_group() as group:
        for _ in range(3):
            group.start_soon(crowd.call, "host")
        await anyio.wait_all_tasks_blocked()
        crowd.capacity.close()
        await anyio.wait_all_tasks_blocked()
        assert crowd.refused == ["server_stopping"] * 2
        await crowd.end_one()
