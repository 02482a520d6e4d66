"""Vehicles of one part of an image that imply another scale than the rest."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector_errors import DetectorErrors
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.ruler import View
from vehanchor.rulers.several_scales import second_scale

SIDE_PX = 1000


def _cars(left: int, right: int, ratio: float, seed: int = 3) -> Detections:
    """Cars of 45 px in the left half, and of ``ratio`` times that in the right one."""
    rng = np.random.default_rng(seed)
    n = left + right
    x = np.concatenate([rng.uniform(50, 450, left), rng.uniform(550, 950, right)])
    lengths = 45.0 * np.exp(rng.normal(0, 0.08, n))
    lengths[left:] *= ratio
    boxes = np.column_stack(
        [x, rng.uniform(50, 950, n), lengths, lengths / 2.2, rng.uniform(0, 3, n)]
    )
    return Detections(boxes, np.full(n, 0.95))


def _ratio(detections: Detections) -> float | None:
    return second_scale(detections, length_m=4.5, errors=DetectorErrors())


def _record(detections: Detections, **facts: Any) -> GsdEstimate:
    view = View(
        ImageFacts(SIDE_PX, SIDE_PX)._replace(**facts),
        detections,
        card=made_card(4.5),
        options=ScaleOptions(),
        measure_detail_share=lambda *_: 1.0,
    )
    return analyse_view(view).estimate


def _codes(record: GsdEstimate) -> set[str]:
    return {notice.code for notice in record.warnings}


def test_cars_of_half_the_length_in_one_half_are_a_second_scale() -> None:
    ratio = _ratio(_cars(12, 6, ratio=0.5))
    assert ratio is not None
    assert 1.8 < ratio < 2.3


def test_cars_of_one_length_are_one_scale() -> None:
    assert _ratio(_cars(12, 12, ratio=1.0)) is None


def test_lorries_among_cars_are_no_second_scale() -> None:
    cars = _cars(15, 15, ratio=1.0)
    cars.boxes[::10, 2] *= 2.0
    assert _ratio(cars) is None


def test_cars_that_the_border_cuts_are_no_second_scale() -> None:
    cars = _cars(12, 6, ratio=0.5)
    assert "several_scales" in _codes(_record(cars))
    # Their boxes reach beyond the right border.
    cars.boxes[12:, 0] = SIDE_PX - 2
    assert "several_scales" not in _codes(_record(cars))


def test_two_scales_are_not_usable() -> None:
    one = _record(_cars(12, 6, ratio=1.0))
    two = _record(_cars(12, 6, ratio=0.5))
    assert "several_scales" in _codes(two)
    assert two.status == "low_confidence"
    assert two.confidence < one.confidence


def test_a_map_has_one_scale() -> None:
    record = _record(_cars(12, 6, ratio=0.5), georeference_gsd_m_per_px=0.1)
    assert "several_scales" not in _codes(record)


def test_a_seam_makes_any_scale_doubtful() -> None:
    note = RasterNote("several_pictures", "a seam")
    record = _record(_cars(12, 12, ratio=1.0), notices=(note,))
    assert record.status == "low_confidence"


def test_a_sphere_has_no_scale_by_its_camera() -> None:
    camera = CameraMetadata(
        make="DJI",
        model="FC220",
        height_m=80.0,
        height_tag="DJI RelativeAltitude",
        focal_35mm=26.0,
        projection="ProjectionType equirectangular",
    )
    record = _record(_cars(1, 0, ratio=1.0), camera=camera)
    assert "camera_unusable" in _codes(record)
    assert "camera" not in {ruler.kind for ruler in record.rulers}
