from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.flight.ground import ground, photograph_of
from tests.models import paint_vehicles, write_detector
from vehanchor.analysis.pipeline import search_raster
from vehanchor.detection.detector import load_detector
from vehanchor.options import ScaleOptions
from vehanchor.rulers.measurement import measure_all
from vehanchor_flight.live.estimator import LiveEstimator
from vehanchor_flight.live.frames import Frame

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

FLEET = 30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3)


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> LiveEstimator:
    path = write_detector(tmp_path_factory.mktemp("model") / "detector.onnx")
    return LiveEstimator(load_detector(path), ScaleOptions(), hold_s=2.0)


@pytest.fixture(scope="module")
def world() -> NDArray[np.uint8]:
    return (ground(1400) // 2).astype(np.uint8)


def frame_of(image: NDArray[np.uint8], at_s: float, *, cars: bool) -> Frame:
    if cars:
        boxes = [[60 + 70 * (k % 6), 80 + 90 * (k // 6), length, 12, 0.4] for k, length in enumerate(FLEET)]
        paint_vehicles(image, np.reshape(boxes, (-1, 5)))
    return Frame(f"at {at_s:.1f} s", image, at_s, 0.0, 0)


def test_the_scale_follows_a_climb_without_cars_and_ends_after_the_hold(
    estimator: LiveEstimator, world: NDArray[np.uint8]
) -> None:
    seen = estimator.estimate(frame_of(photograph_of(world, 700, 700), 0.0, cars=True))
    assert seen.gsd_m_per_px is not None
    assert seen.n_vehicles > 4
    assert not seen.linked
    estimator.estimate(frame_of(photograph_of(world, 700, 700), 0.2, cars=False))
    scale = 1.0
    for step in range(1, 9):
        scale = math.exp(0.02 * step)
        climbed = estimator.estimate(
            frame_of(
                photograph_of(world, 700 + 8 * step, 700, scale=scale, turn_deg=3 * step), 0.2 + 0.2 * step, cars=False
            )
        )
    assert climbed.linked
    assert climbed.n_vehicles == 0
    assert climbed.gsd_m_per_px == pytest.approx(seen.gsd_m_per_px * scale, rel=0.02)
    assert climbed.seen_s_ago == pytest.approx(1.8)
    late = estimator.estimate(frame_of(photograph_of(world, 700, 700), 4.0, cars=False))
    assert (late.status, late.gsd_m_per_px, late.confidence) == ("no_scale", None, 0.0)


def test_a_frame_that_shows_nothing_gives_nothing(tmp_path: Path) -> None:
    detector = load_detector(write_detector(tmp_path / "detector.onnx"))
    empty = LiveEstimator(detector, ScaleOptions())
    for number in range(3):
        record = empty.estimate(Frame("grey", np.full((90, 160, 3), 80, np.uint8), 0.2 * number, 0.0, 0))
        assert (record.status, record.gsd_m_per_px, record.linked) == ("no_scale", None, False)


def test_a_stretch_found_once_is_kept_and_tested_now_and_then(
    tmp_path: Path, world: NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "vehanchor_flight.live.estimator"
    tested: list[bool] = []
    kept: list[float | None] = []

    def searched(*arguments: Any, check_stretch: bool) -> View:
        view = search_raster(*arguments, check_stretch=check_stretch)
        tested.append(check_stretch)
        scales = np.ones(len(view.detections.boxes))
        stretched = replace(view.detections, stretch=7.0 if check_stretch else None, scales=scales)
        return replace(view, detections=stretched)

    def measured(view: View) -> tuple[Witness, ...]:
        kept.append(view.detections.stretch)
        return measure_all(view)

    monkeypatch.setattr(f"{module}.search_raster", searched)
    monkeypatch.setattr(f"{module}.measure_all", measured)
    estimator = LiveEstimator(load_detector(write_detector(tmp_path / "detector.onnx")), ScaleOptions())
    for number in range(12):
        record = estimator.estimate(frame_of(photograph_of(world, 700, 700), 0.2 * number, cars=True))
        assert record.status != "ok"
    assert [number for number, each in enumerate(tested) if each] == [0, 10]
    assert kept == [7.0] * 12
