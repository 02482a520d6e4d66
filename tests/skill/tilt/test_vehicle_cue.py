from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_detections
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import equivalent_lens
from vehanchor.options import ScaleOptions
from vehanchor.rulers.view import View
from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.estimate import tilt_from_vehicles
from vehanchor.tilt.posterior import TiltPosterior
from vehanchor.tilt.vehicle_cue import LEAST_CARS

WIDTH, HEIGHT = 1000, 750
FOCAL_PX = equivalent_lens(WIDTH, HEIGHT, 26.0).pixels


def _cars(tilt_deg: float, *, n: int = 60, roll_deg: float = 0.0, seed: int = 0, lorries: int = 0) -> Detections:
    """Cars of one fleet all over the image, as a camera sees them that looked aside."""
    rng = np.random.default_rng(seed)
    plane = GroundPlane(0.08, tilt_deg, FOCAL_PX, WIDTH, HEIGHT, roll_deg)
    places = rng.uniform((60, 60), (WIDTH - 60, HEIGHT - 60), (n, 2))
    sizes = np.exp(rng.normal(0, 0.08, n)) / plane.gsd_at(places)
    sizes[:lorries] *= 2.5
    boxes = np.column_stack([places, 4.5 * sizes, 1.8 * sizes * np.exp(rng.normal(0, 0.1, n)), rng.uniform(0, 3, n)])
    return Detections(boxes, np.full(n, 0.9))


def _lean(*arguments: Any, **options: Any) -> TiltPosterior:
    found = tilt_from_vehicles(_cars(*arguments, **options), WIDTH, HEIGHT, FOCAL_PX)
    assert found is not None
    return found


@pytest.mark.parametrize("roll_deg", [0.0, 100.0, 190.0])
@pytest.mark.parametrize("tilt_deg", [15.0, 30.0, 40.0])
def test_cars_tell_how_far_aside_and_in_which_direction_the_camera_looked(tilt_deg: float, roll_deg: float) -> None:
    found = _lean(tilt_deg, roll_deg=roll_deg)
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=5)
    assert found.low_deg < found.tilt_deg < found.high_deg
    assert abs((found.roll_deg - roll_deg + 180) % 360 - 180) <= 15


def test_seen_from_straight_above_few_fleets_lean() -> None:
    found = [_lean(0.0, n=30, seed=seed) for seed in range(60)]
    assert sum(each.chance_above(10) >= 0.99 for each in found) == 0
    assert np.median([each.tilt_deg for each in found]) < 4


def test_a_lorry_park_on_one_side_does_not_lean_the_ground() -> None:
    detections = _cars(0.0, lorries=9)
    order = np.argsort(detections.boxes[:, 1])
    boxes = detections.boxes.copy()
    boxes[:9, :2], boxes[order[:9], :2] = detections.boxes[order[:9], :2], detections.boxes[:9, :2]
    found = tilt_from_vehicles(Detections(boxes, detections.scores), WIDTH, HEIGHT, FOCAL_PX)
    assert found is not None
    assert found.chance_above(10) < 0.99


def test_few_cars_tell_nothing() -> None:
    assert tilt_from_vehicles(_cars(30.0, n=LEAST_CARS - 1), WIDTH, HEIGHT) is None
    assert tilt_from_vehicles(Detections(np.zeros((0, 5)), np.zeros(0)), WIDTH, HEIGHT) is None


def _codes(detections: Detections, **image: Any) -> list[str]:
    view = View(ImageFacts(WIDTH, HEIGHT, **image), detections, made_card(4.6), ScaleOptions(), lambda *_: 1.0)
    return [notice.code for notice in analyse_detections(view).estimate.warnings]


def test_a_tilt_that_nobody_knows_is_a_warning_and_changes_no_number() -> None:
    assert "tilt_suspected" in _codes(_cars(35.0))
    assert "tilt_suspected" not in _codes(_cars(0.0))
    assert "tilt_suspected" not in _codes(_cars(35.0), georeference_gsd_m_per_px=0.08)
    looked_down = CameraMetadata(off_nadir_deg=0.0)
    assert "tilt_suspected" not in _codes(_cars(35.0), camera=looked_down)
