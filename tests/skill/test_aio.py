from __future__ import annotations

import inspect
import threading
from collections.abc import Callable

import anyio
import anyio.to_thread
import numpy as np
import pytest

import vehanchor
import vehanchor.aio
from tests.models import blank_image, paint_vehicles, write_detector
from tests.tiles import watched_tiles
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError

pytestmark = pytest.mark.anyio
PATH = [(10.0, 20.0), (310.0, 420.0)]


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector(write_detector(tmp_path_factory.mktemp("detector") / "painted.onnx"))


def _place() -> np.ndarray:
    image = blank_image(800, 600)
    boxes = [[40 + 70 * (k % 10), 40 + 60 * (k // 10), 30 + 0.1 * k, 12, 0.4] for k in range(30)]
    paint_vehicles(image, np.array(boxes))
    return image


async def test_the_records_are_those_of_the_verbs(detector: Detector) -> None:
    image = _place()
    estimate = await vehanchor.aio.estimate_gsd(image, detector=detector, reference_length_m=4.6)
    assert estimate == vehanchor.estimate_gsd(image, detector=detector, reference_length_m=4.6)
    distance = await vehanchor.aio.measure_distance(image, PATH, scale=estimate)
    assert distance == vehanchor.measure_distance(image, PATH, scale=estimate)


async def test_the_errors_are_those_of_the_verbs() -> None:
    with pytest.raises(InvalidParameterError, match="there is no option 'regoin'"):
        await vehanchor.aio.estimate_gsd(_place(), regoin="europe")  # type: ignore[call-overload]


async def test_who_waits_no_more_is_not_kept(detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    returned, in_thread, thread_ended = anyio.Event(), anyio.to_thread.run_sync, threading.Event()

    async def noted(work: Callable[[], object], *, abandon_on_cancel: bool) -> object:
        def to_its_end() -> object:
            try:
                return work()
            finally:
                thread_ended.set()

        return await in_thread(to_its_end, abandon_on_cancel=abandon_on_cancel)

    async def estimate() -> None:
        try:
            await vehanchor.aio.estimate_gsd(_place(), detector=detector, tile_px=128, stride_px=96)
        finally:
            returned.set()

    with watched_tiles() as tiles:
        async with anyio.create_task_group() as group:
            with tiles.held(), monkeypatch.context() as patches:
                patches.setattr("vehanchor.aio.anyio.to_thread.run_sync", noted)
                group.start_soon(estimate)
                while tiles.n_begun == 0:
                    await anyio.sleep(0.01)
                group.cancel_scope.cancel()
                with anyio.CancelScope(shield=True):
                    await returned.wait()  # although its tile is still held
        await anyio.to_thread.run_sync(thread_ended.wait)
    assert tiles.n_begun == 1, "the search went on"


async def test_a_list_of_images_gives_a_list_of_records(detector: Detector) -> None:
    images = [_place(), _place()[::-1]]
    assert await vehanchor.aio.estimate_gsd(images, detector=detector) == vehanchor.estimate_gsd(
        images, detector=detector
    )


@pytest.mark.parametrize("verb", ["estimate_gsd", "measure_area", "measure_distance"])
def test_every_verb_has_a_twin_of_the_same_arguments(verb: str) -> None:
    assert verb in vehanchor.aio.__all__
    twin, original = getattr(vehanchor.aio, verb), getattr(vehanchor, verb)
    assert inspect.signature(twin) == inspect.signature(original)
    assert inspect.iscoroutinefunction(twin)
