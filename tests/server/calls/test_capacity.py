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


async def test_work_runs_in_a_thread_and_gives_its_value() -> None:
    capacity = Capacity(1, 5)
    assert await capacity.run(lambda stop: capacity.in_thread(stop, threading.get_ident)) != threading.get_ident()
    assert capacity.running == 0


async def test_errors_of_the_work_come_through_as_they_are() -> None:
    capacity = Capacity(1, 5)

    def broken() -> None:
        raise KeyError("x")

    with pytest.raises(KeyError):
        await capacity.run(lambda stop: capacity.in_thread(stop, broken))
    assert capacity.running == 0


async def test_a_finished_call_was_not_stopped() -> None:
    stops: list[Stop] = []
    capacity = Capacity(1, 5)

    async def call(stop: Stop) -> None:
        stops.append(stop)
        await capacity.in_thread(stop, lambda: None)

    await capacity.run(call)
    assert not stops[0].requested


async def test_a_place_is_taken_until_the_thread_has_ended() -> None:
    capacity = Capacity(1, 5)
    began, release = threading.Event(), threading.Event()

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


async def test_the_deadline_stops_the_work() -> None:
    capacity = Capacity(1, 0.1)
    with pytest.raises(CallError) as caught:  # work that nobody stops never ends
        await capacity.run(lambda stop: capacity.in_thread(stop, lambda: work_until_stopped(stop)))
    assert caught.value.code == "deadline_exceeded"
    assert capacity.running == 0


async def test_the_deadline_counts_before_the_thread_as_well() -> None:
    capacity = Capacity(1, 0.1)
    with pytest.raises(CallError, match="deadline_exceeded"):
        await capacity.run(lambda _: anyio.sleep(5))


async def test_whatever_stopped_work_raises_ends_in_the_cancellation() -> None:
    capacity = Capacity(1, 0.1)

    def terminated(stop: Stop) -> None:
        while not stop.requested:
            time.sleep(0.005)
        raise RuntimeError("Exiting due to terminate flag being set to true.")

    with pytest.raises(CallError, match="deadline_exceeded"):
        await capacity.run(lambda stop: capacity.in_thread(stop, lambda: terminated(stop)))


async def test_closing_stops_what_runs_and_accepts_nothing_more() -> None:
    capacity = Capacity(2, 5)
    codes: list[str] = []

    async def call() -> None:
        try:
            await capacity.run(lambda stop: capacity.in_thread(stop, lambda: work_until_stopped(stop)))
        except CallError as error:
            codes.append(error.code)

    async with anyio.create_task_group() as group:
        group.start_soon(call)
        while not capacity.running:
            await anyio.sleep(0.001)
        capacity.close()
    await call()
    assert codes == ["server_stopping", "server_stopping"]


async def test_an_action_is_done_once_and_only_within_its_context() -> None:
    stop, done = Stop(), []
    with stop.calling(lambda: done.append("over")):
        pass
    with stop.calling(lambda: done.append("during")):
        stop.request()
        stop.request()
    with stop.calling(lambda: done.append("after")):
        pass
    assert done == ["during", "after"]
