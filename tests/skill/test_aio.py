from __future__ import annotations

import time
from pathlib import Path

import anyio
import numpy as np
import pytest

import vehanchor
import vehanchor.aio
from tests.models import blank_image, paint_vehicles, write_detector
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
        await vehanchor.aio.estimate_gsd(_place(), regoin="europe")


async def test_who_waits_no_more_is_not_kept(detector: Detector, monkeypatch: pytest.MonkeyPatch) -> None:
    original, n_tiles = Detector.detect_tile, []

    def slowed(self: Detector, *args: object, **kwargs: object) -> object:
        n_tiles.append(1)
        time.sleep(0.3)
        return original(self, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(Detector, "detect_tile", slowed)
    started = time.monotonic()
    with anyio.move_on_after(0.1) as scope:
        await vehanchor.aio.estimate_gsd(_place(), detector=detector, tile_px=128, stride_px=96)
    assert scope.cancelled_caught
    assert time.monotonic() - started < 1
    await anyio.sleep(1.5)
    assert len(n_tiles) <= 3, "the search went on"


def test_all_three_verbs_have_a_twin() -> None:
    assert set(vehanchor.aio.__all__) == {"estimate_gsd", "measure_area", "measure_distance"}
    assert Path(vehanchor.aio.__file__).exists()
