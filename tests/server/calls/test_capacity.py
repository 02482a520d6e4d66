"""Slots of calls, whatever the calls do."""

from __future__ import annotations

import threading
import time

import anyio
import pytest

from vehanchor_server.calls.capacity import Capacity, Stop
from vehanchor_server.errors import CallError

pytestmark = pytest.mark.anyio


def work_until_stopped(stop: Stop) -> None:
    while True:
        stop.check()
        time.sleep(0.005)


async def test_a_slot_is_taken_until_the_thread_has_ended() -> None:
    capacity = Capacity(1, 5)
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
    capacity = Capacity(2, 5)
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
