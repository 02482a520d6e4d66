"""A tilt that the sizes of the cars show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import equivalent_lens
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.camera_tilt import MIN_CARS, suspected_tilt, tilt_doubt
from vehanchor.rulers.ruler import View
from vehanchor.scale.plane import GroundPlane
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.pooling import pool

WIDTH = 1000
HEIGHT = 750
FOCAL_PX = equivalent_lens(WIDTH, HEIGHT, 26.0).pixels


def _cars(
    tilt_deg: float, *, n: int = 60, roll_deg: float = 0.0, seed: int = 0, lorries: int = 0
) -> Detections:
    """Cars of one fleet all over the image, as a tilted camera sees them."""
    rng = np.random.default_rng(seed)
    plane = GroundPlane(
        0.08, tilt_deg, focal_px=FOCAL_PX, width_px=WIDTH, height_px=HEIGHT, roll_deg=roll_deg
    )
    places = rng.uniform((60, 60), (WIDTH - 60, HEIGHT - 60), (n, 2))
    sizes = np.exp(rng.normal(0, 0.08, n)) / plane.gsd_at(places)
    sizes[:lorries] *= 2.5
    widths = 1.8 * sizes * np.exp(rng.normal(0, 0.1, n))
    boxes = np.column_stack([places, 4.5 * sizes, widths, rng.uniform(0, 3, n)])
    return Detections(boxes, np.full(n, 0.9))


def _suspected(detections: Detections, log_size_sd: float = 0.11) -> float | None:
    return suspected_tilt(detections, WIDTH, HEIGHT, focal_px=FOCAL_PX, log_size_sd=log_size_sd)


@pytest.mark.parametrize("roll_deg", [0.0, 100.0, 190.0])
@pytest.mark.parametrize("tilt_deg", [30.0, 40.0])
def test_cars_that_grow_to_one_side_tell_the_tilt(tilt_deg: float, roll_deg: float) -> None:
    assert _suspected(_cars(tilt_deg, roll_deg=roll_deg)) == pytest.approx(tilt_deg, abs=5)


def test_a_detector_with_uneven_boxes_shows_no_tilt() -> None:
    detections = _cars(30.0)
    assert _suspected(detections) is not None
    assert _suspected(detections, log_size_sd=1.0) is None


def test_at_nadir_no_fleet_seems_tilted() -> None:
    assert all(_suspected(_cars(0.0, n=30, seed=seed)) is None for seed in range(60))


def test_a_lorry_park_on_one_side_is_no_tilt() -> None:
    detections = _cars(0.0, lorries=9)
    # The nine lorries change places with the nine uppermost vehicles.
    uppermost = np.argsort(detections.boxes[:, 1])[:9]
    boxes = detections.boxes.copy()
    boxes[:9, :2] = detections.boxes[uppermost, :2]
    boxes[uppermost, :2] = detections.boxes[:9, :2]
    assert _suspected(Detections(boxes, detections.scores)) is None


@pytest.mark.parametrize(
    "detections", [_cars(30.0, n=MIN_CARS - 1), Detections(np.zeros((0, 5)), np.zeros(0))]
)
def test_few_cars_tell_nothing(detections: Detections) -> None:
    assert _suspected(detections) is None


def _view(detections: Detections, **image: Any) -> View:
    return View(
        ImageFacts(WIDTH, HEIGHT, **image),
        detections,
        card=made_card(4.6),
        options=ScaleOptions(),
        measure_detail_share=lambda *_: 1.0,
    )


def _codes(record: GsdEstimate) -> list[str]:
    return [notice.code for notice in record.warnings]


def test_an_unknown_tilt_is_a_warning_unless_the_file_knows_it() -> None:
    def codes(detections: Detections, **image: Any) -> list[str]:
        return _codes(analyse_view(_view(detections, **image)).estimate)

    assert "tilt_suspected" in codes(_cars(35.0))
    assert "tilt_suspected" not in codes(_cars(0.0))
    assert "tilt_suspected" not in codes(_cars(35.0), georeference_gsd_m_per_px=0.08)
    assert "tilt_suspected" not in codes(_cars(35.0), camera=CameraMetadata(off_nadir_deg=0.0))


def test_pooled_photographs_do_not_repeat_the_doubt() -> None:
    views = [_view(_cars(35.0, seed=seed)) for seed in range(2)]
    stored = [
        StoredPhotograph(view.image, view.detections, detail_share=1.0, others=()) for view in views
    ]
    seen = [
        Photograph.of("a", kept, view.card, view.options)
        for kept, view in zip(stored, views, strict=True)
    ]
    assert all("tilt_suspected" in _codes(each.analysis.estimate) for each in seen)
    assert "tilt_suspected" not in _codes(pool(seen, np.zeros(2), 0).estimate)


# --- Few cars, from a pole


def _chance(detections: Detections, log_size_sd: float = 0.11, **image: Any) -> float:
    facts = ImageFacts(WIDTH, HEIGHT, **image)
    return tilt_doubt(facts, ScaleOptions(), detections, log_size_sd=log_size_sd).chance


@pytest.mark.parametrize("n", [4, 8])
def test_few_cars_that_grow_downwards_may_be_seen_from_a_pole(n: int) -> None:
    chances = [_chance(_cars(45.0, n=n, seed=seed)) for seed in range(20)]
    assert np.median(chances) > 0.5


@pytest.mark.parametrize("n", [1, 2, 3, 6, 11])
def test_few_cars_at_nadir_hardly_seem_to_be_seen_from_a_pole(n: int) -> None:
    chances = np.array([_chance(_cars(0.0, n=n, seed=seed)) for seed in range(60)])
    assert np.mean(chances > 0.05) < 0.05


def test_cars_that_grow_upwards_are_not_seen_from_a_pole() -> None:
    chances = [_chance(_cars(45.0, n=6, roll_deg=180.0, seed=seed)) for seed in range(20)]
    assert np.median(chances) < 0.01


def test_a_lorry_below_few_cars_is_no_tilt() -> None:
    detections = _cars(0.0, n=5, lorries=1)
    boxes = detections.boxes.copy()
    boxes[0, 1] = HEIGHT - 150
    assert _chance(Detections(boxes, detections.scores)) < 0.05


def test_a_doubtful_box_below_a_car_is_no_tilt() -> None:
    detections = _cars(0.0, n=2, lorries=1)
    boxes = detections.boxes.copy()
    boxes[:, :2] = [(500, HEIGHT - 200), (500, 200)]
    assert _chance(Detections(boxes, np.array([0.9, 0.9]))) > 0.1
    assert _chance(Detections(boxes, np.array([0.6, 0.9]))) == 0.0


def test_a_known_tilt_leaves_no_chance_of_another() -> None:
    few = _cars(45.0, n=8)
    assert _chance(few) > 0.5
    assert _chance(few, georeference_gsd_m_per_px=0.08) == 0.0
    assert _chance(few, camera=CameraMetadata(off_nadir_deg=0.0)) == 0.0


def test_few_cars_seen_from_a_pole_give_no_usable_scale() -> None:
    record = analyse_view(_view(_cars(45.0, n=8))).estimate
    assert record.status != "ok"
    assert "tilt_suspected" in _codes(record)
