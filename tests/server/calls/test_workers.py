"""Calls in worker processes: answers are the same, and the server survives any failure."""

from __future__ import annotations

import base64
import errno
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
import rasterio.transform
from mcp import Client
from mcp.server import MCPServer

from tests.sam_models import SamFiles
from tests.server.calls.slow_models import weighed_down
from tests.server.calls.working import IMAGE, TESTS, Value, answered, done, number, ready
from tests.server.conftest import POOL_BOX, paint_scene
from tests.server.conversation import by_path, error_of, text_of
from vehanchor_server.app import create_server
from vehanchor_server.calls.capacity import CallStoppedError, Stop
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import Task, work
from vehanchor_server.calls.worker_process import WorkerLimits, serve_tasks
from vehanchor_server.calls.workers import WorkerPool
from vehanchor_server.errors import CallError
from vehanchor_server.resources import Resources, create_resources
from vehanchor_server.services import Services, create_services
from vehanchor_server.settings import Settings

pytestmark = [pytest.mark.anyio, pytest.mark.slow]


@pytest.fixture(scope="module")
def isolated(images: Path, detector_path: Path, segmenter_paths: SamFiles) -> Iterator[Services]:
    settings = Settings(
        roots=(images, TESTS),
        detector=str(detector_path),
        segmenter=segmenter_paths,
        threads=1,
        max_concurrency=1,
        max_megapixels=60,
    )
    services = ready(create_services(settings))
    yield services
    services.close()


@pytest.fixture
def isolated_server(isolated: Services) -> MCPServer[object]:
    return create_server(isolated)


@pytest.fixture
def georeferenced(images: Path) -> Iterator[Path]:
    """An image that GDAL and PROJ read, with files of their own."""
    path = images / "cars.tif"
    place = rasterio.transform.Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)
    shape = {"width": 640, "height": 512, "count": 3, "dtype": "uint8", "compress": "deflate"}
    with rasterio.open(path, "w", "GTiff", crs="EPSG:32633", transform=place, **shape) as file:
        file.write(paint_scene(640, 512).transpose(2, 0, 1))
    yield path
    path.unlink()


@work(Value)
def wait_for(resources: Resources, job: Job, source: Any, mark: Path) -> Reply[Value]:
    """Report something, then wait until a file exists; answer with the process id."""
    job.segmenting()
    while not mark.exists():
        time.sleep(0.01)
    return answered(os.getpid())


@contextmanager
def waiting_worker(services: Services, mark: Path, stop: Stop | None = None) -> Iterator[Any]:
    """The future process id of a worker that waits until a file exists."""
    assert services.workers is not None
    begun = threading.Event()

    def report(*_: object) -> None:
        begun.set()

    task = Task(wait_for, mark, ((IMAGE, None),))
    with ThreadPoolExecutor() as threads:
        reply = threads.submit(services.workers.run, task, stop or Stop(), report)
        reply.add_done_callback(report)
        begun.wait()
        yield reply


@work(Value)
def crash(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    os.kill(os.getpid(), signal.SIGSEGV)
    raise AssertionError


@work(Value)
def fill(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    return answered(float(np.ones(1 << 29).sum()))  # 4 GiB


@work(Value)
def bug(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    raise KeyError("hunter2")


async def test_answers_are_those_of_one_process(
    isolated: Services, isolated_server: MCPServer[object], images: Path, georeferenced: Path
) -> None:
    server = create_server(
        create_services(replace(isolated.resources.settings, isolation="in-process"))
    )
    reports: list[Any] = []

    async def on_progress(progress: float, total: float | None, message: str | None) -> None:
        reports.append((progress, message))

    for tool, arguments in (
        ("estimate_gsd", by_path(images / "cars.png")),
        ("view_image", {"of": {"tool": "estimate_gsd", "arguments": by_path(images / "cars.png")}}),
        ("measure_area", {**by_path(images / "pool.png"), "targets": [{"box": POOL_BOX}]}),
        ("estimate_gsd", by_path(georeferenced)),
        (
            "estimate_gsd",
            {
                "image": {
                    "kind": "base64",
                    "data": base64.b64encode(georeferenced.read_bytes()).decode(),
                }
            },
        ),
        ("estimate_gsd", by_path(images / "notes.txt")),
        ("estimate_gsd", by_path("/etc/passwd")),
        ("estimate_gsd", {**by_path(images / "cars.png"), "region": "atlantis"}),
    ):
        answers = []
        progress = []
        for one_server in (isolated_server, server):
            reports.clear()
            async with Client(one_server) as client:
                answers.append(
                    await client.call_tool(tool, arguments, progress_callback=on_progress)
                )
            progress.append(list(reports))
        assert answers[0].structured_content == answers[1].structured_content
        assert answers[0].content == answers[1].content
        assert progress[0] == progress[1]


@pytest.mark.promise("deadline")
def test_a_worker_is_replaced_before_the_next_call(isolated: Services) -> None:
    assert isolated.workers is not None
    with pytest.raises(CallError, match="worker_killed"):
        done(isolated, crash)
    (successor,) = isolated.workers.processes
    ready(isolated)
    assert done(isolated, number) == successor


def test_a_stop_kills_the_worker(isolated: Services, tmp_path: Path) -> None:
    stop = Stop()
    before = done(isolated, number)
    with waiting_worker(isolated, tmp_path / "never", stop) as reply:
        stop.cancel()
        with pytest.raises(CallStoppedError):
            reply.result()
    _until_dead(before)
    assert done(isolated, number) != before


@work(Value)
def allocation_refused(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    raise CallError(
        "image_undecodable", "the JPEG cannot be decoded: Failed to allocate 300000000 bytes."
    )


@pytest.mark.promise("memory")
@pytest.mark.parametrize("task", [fill, allocation_refused])
def test_a_worker_without_memory_is_ended(isolated: Services, task: Any) -> None:
    with pytest.raises(CallError, match=r"worker_killed: .*memory"):
        done(isolated, task)
    assert done(isolated, number) > 0


def test_a_bug_does_not_end_the_worker(isolated: Services) -> None:
    worker = done(isolated, number)
    with pytest.raises(RuntimeError, match="hunter2"):
        done(isolated, bug)
    assert done(isolated, number) == worker


@pytest.mark.promise("deadline")
async def test_the_deadline_is_kept_by_a_worker_that_does_not_listen(
    images: Path, detector_path: Path, tmp_path: Path
) -> None:
    settings = Settings(
        roots=(images,),
        detector=str(weighed_down(detector_path, tmp_path / "slow.onnx")),
        threads=1,
        max_concurrency=1,
        deadline_s=1.0,
    )
    services = ready(create_services(settings))
    assert services.workers is not None
    (deaf,) = services.workers.processes
    try:
        async with Client(create_server(services)) as client:
            result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
            assert error_of(result) == "deadline_exceeded"
            assert services.workers.processes != [deaf]
            assert services.capacity.running == 0
            await anyio.to_thread.run_sync(ready, services)
            result = await client.call_tool("estimate_gsd", by_path(images / "notes.txt"))
            assert error_of(result) == "image_undecodable", text_of(result)
    finally:
        services.close()


async def test_a_model_that_cannot_be_loaded_is_the_operators_business(images: Path) -> None:
    services = create_services(
        Settings(roots=(images,), detector="/nowhere/secret.onnx", max_concurrency=1)
    )
    try:
        async with Client(create_server(services)) as client:
            result = await client.call_tool("estimate_gsd", by_path(images / "cars.png"))
        assert error_of(result) == "model_unavailable"
        assert "secret" not in text_of(result)
        assert not services.ready
        assert services.failure == "model_not_found"
    finally:
        services.close()


def _lives(pid: int) -> bool:
    """Whether a process has memory; it may end at any moment."""
    try:
        return bool(Path(f"/proc/{pid}/maps").read_bytes())
    except (FileNotFoundError, ProcessLookupError):
        return False


def _until_dead(*processes: int) -> None:
    while any(map(_lives, processes)):
        time.sleep(0.02)


@pytest.fixture
def roomy(settings: Settings) -> Iterator[Services]:
    """A server with room for three calls, and one worker so far."""
    roots = (*settings.roots, TESTS)
    own = replace(settings, roots=roots, isolation="confined", max_concurrency=3)
    services = ready(create_services(own))
    yield services
    services.close()


def test_calls_one_after_the_other_share_a_worker(roomy: Services) -> None:
    assert roomy.workers is not None
    assert len(roomy.workers.processes) == 1
    assert done(roomy, number) == done(roomy, number)
    assert len(roomy.workers.processes) == 1


def test_calls_at_the_same_time_have_workers_of_their_own(roomy: Services, tmp_path: Path) -> None:
    assert roomy.workers is not None
    mark = tmp_path / "mark"
    with waiting_worker(roomy, mark) as reply:
        second = done(roomy, number)
        mark.touch()
    assert second != reply.result().record.value
    assert len(roomy.workers.processes) == 2


def test_closing_ends_all_workers(roomy: Services, tmp_path: Path) -> None:
    assert roomy.workers is not None
    mark = tmp_path / "mark"
    with waiting_worker(roomy, mark):
        done(roomy, number)
        mark.touch()
    processes = roomy.workers.processes
    assert len(processes) == 2
    roomy.close()
    _until_dead(*processes)


def not_there() -> Resources:
    raise ModuleNotFoundError("No module named 'cv2'")


def crashes() -> Resources:
    os._exit(3)


def killed() -> Resources:  # as a system does that has no memory left
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


@pytest.mark.parametrize(
    ("make_resources", "words"),
    [(not_there, "No module named 'cv2'"), (crashes, "exit code 3"), (killed, "exit code -9")],
)
def test_a_worker_that_never_starts_is_logged_once(
    make_resources: Any, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    workers = WorkerPool(make_resources, WorkerLimits(1 << 30, 10))
    workers.start()
    for _ in range(2):
        with pytest.raises(CallError, match=r"worker_unavailable: .* the image is not the cause"):
            workers.run(Task(number, None, ((IMAGE, None),)), Stop(), lambda *_: None)
    assert workers.failure == "worker_unavailable"
    assert not workers.ready
    (line,) = caplog.records
    assert words in line.getMessage()


def test_a_refused_process_is_not_the_images_fault(
    monkeypatch: pytest.MonkeyPatch, isolated: Services
) -> None:
    def refused(self: Any) -> None:
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    assert isolated.workers is not None
    (process,) = isolated.workers.processes
    with monkeypatch.context() as patches:
        patches.setattr(BaseProcess, "start", refused)
        with pytest.raises(CallError, match="worker_killed"):
            done(isolated, crash)
        with pytest.raises(CallError, match="worker_unavailable"):
            done(isolated, number)
    assert done(isolated, number) != process


def endless() -> Resources:  # as a model that computes for ever while it is loaded
    while True:
        time.sleep(1)


def test_a_call_to_a_worker_that_loads_for_ever_ends_at_its_deadline() -> None:
    workers = WorkerPool(endless, WorkerLimits(1 << 30, 10))
    stop = Stop()
    timer = threading.Timer(0.5, stop.cancel)
    timer.start()
    try:
        with pytest.raises(CallStoppedError):
            workers.run(Task(number, None, ((IMAGE, None),)), stop, lambda *_: None)
        assert not workers.ready
    finally:
        timer.join()
        workers.close()


def lost_once(mark: Path, settings: Settings) -> Resources:
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return create_resources(settings)


@pytest.mark.parametrize("is_lost", [True, False])
def test_a_call_starts_another_worker_only_if_its_own_is_killed(
    tmp_path: Path, detector_path: Path, is_lost: bool
) -> None:
    settings = Settings(
        roots=(tmp_path, TESTS), detector=str(detector_path), threads=1, max_concurrency=1
    )
    make = (
        partial(lost_once, tmp_path / "mark", settings)
        if is_lost
        else partial(create_resources, settings)
    )
    workers = WorkerPool(make, WorkerLimits(1 << 30, 10))
    workers.start()
    (first,) = workers.processes
    try:
        answer = workers.run(Task(number, None, ((IMAGE, None),)), Stop(), lambda *_: None)
        assert workers.processes == [answer.record.value]
        assert (answer.record.value != first) == is_lost
    finally:
        workers.close()


def test_a_worker_ends_silently_with_its_server(tmp_path: Path, detector_path: Path) -> None:
    settings = Settings(roots=(tmp_path, TESTS), detector=str(detector_path), threads=1)
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    log, written = context.Pipe(duplex=False)
    worker = context.Process(
        target=serve_tasks,
        args=(theirs, written, partial(create_resources, settings), WorkerLimits(1 << 30, 10)),
    )
    worker.start()
    theirs.close()
    written.close()
    # the worker has sent that its models are loaded; the unread message makes the close a reset
    assert ours.poll(60)
    ours.close()
    worker.join(60)
    assert worker.exitcode == 0
    with log, open(log.fileno(), closefd=False) as lines:
        assert "Traceback" not in lines.read()
