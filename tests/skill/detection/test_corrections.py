"""Vehicles that the caller drops or adds, from the search to the record."""

from __future__ import annotations

from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest

from tests.analyses import analyse_found, made_card
from tests.models import blank_image
from vehanchor import Engine
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.batch.run import run_batch
from vehanchor.detection.detections import Appearance, Detections, corrected
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError
from vehanchor.options import ScaleOptions
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records.notices import NoticeCode

_SIDE = 4000


def _detections(
    groups: list[tuple[float, int]],
    *,
    score: float = 0.8,
    appearance: Appearance | None = None,
    spread: float = 0.07,
) -> Detections:
    """Groups of (length, number) with the spread of a fleet, each in a row of its own."""
    boxes = []
    for row, (length, n) in enumerate(groups, 1):
        for k in range(n):
            quantile = NormalDist().inv_cdf((k + 0.5) / n)
            boxes.append(
                [50 + 99.0 * k, 100.0 * row, length * (1 + spread * quantile), length / 2.2, 0.0]
            )
    return Detections(
        np.array(boxes).reshape(-1, 5),
        np.full(len(boxes), score),
        reductions=np.ones(len(boxes)),
        appearance=appearance,
    )


_TWELVE = _detections([(40.0, 12)])
"""Twelve cars of 40 px."""

_TWO_GROUPS = _detections([(40.0, 12), (100.0, 10)])
"""Twelve cars of 40 px, and ten vehicles of 100 px."""

_GRID = PixelGrid(_SIDE, _SIDE)


def _corrected(detections: Detections, **keywords: Any) -> Detections:
    options = ScaleOptions.of(keywords).in_pixels(_GRID)
    return corrected(
        detections,
        options.by_hand,
        CoordinateFrame(options.frame, _GRID),
        nms_iou=options.search.nms_iou,
        length_over_width=2.21,
    )


def _analysis(detections: Detections, **keywords: Any) -> ScaleAnalysis:
    return analyse_found(
        _corrected(detections, **keywords),
        made_card(),
        ScaleOptions(),
        image_width_px=_SIDE,
        image_height_px=_SIDE,
    )


def test_without_corrections_nothing_changes() -> None:
    assert _corrected(_TWELVE) is _TWELVE
    assert _analysis(_TWELVE).estimate.details.by_hand is None
    assert _TWELVE.numbers.tolist() == list(range(1, 13))


# --- Dropped vehicles


def test_dropping_other_vehicles_raises_the_confidence() -> None:
    both = _analysis(_TWO_GROUPS).estimate
    one = _analysis(_TWO_GROUPS, drop=range(13, 23)).estimate
    assert both.confidence < one.confidence
    assert one.warnings == ()


def test_dropped_vehicles_are_not_evidence() -> None:
    estimate = _analysis(_TWO_GROUPS, drop=range(13, 23)).estimate
    alone = _analysis(_TWELVE).estimate
    assert estimate.details.by_hand is not None
    assert estimate.details.by_hand.dropped == 10
    details = estimate.details.model_copy(update={"by_hand": None})
    assert estimate.model_copy(update={"details": details}) == alone


def test_the_other_vehicles_keep_their_numbers() -> None:
    analysis = _analysis(_TWO_GROUPS, drop=[1, 3])
    assert analysis.detections.numbers.tolist() == [2, *range(4, 23)]
    features = analysis.__geo_interface__["features"]
    assert [feature["properties"]["number"] for feature in features[:2]] == [2, 4]


def test_a_number_that_does_not_exist_shows_how_many_there_are() -> None:
    with pytest.raises(
        InvalidParameterError,
        match=r"drop has number 13, which is not a vehicle .* are 1 to 12",
    ):
        _corrected(_TWELVE, drop=[2, 13])


def test_a_number_of_an_image_without_vehicles_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="no vehicle was found"):
        _corrected(_detections([]), drop=[1])


# --- Added vehicles


# Three vehicles of 132 px.
_LONG_AXES = [(3000, y, 3100 + y / 100, y) for y in (3000, 3200, 3400)]


def test_added_vehicles_do_not_outvote_many_others() -> None:
    analysis = _analysis(_detections([(40.0, 20)]), add=_LONG_AXES)
    assert analysis.estimate.mode_length_px == pytest.approx(40, rel=0.05)
    assert analysis.kept.tolist() == [True] * 20 + [False] * 3


def test_an_added_vehicle_unlike_the_others_gives_a_notice() -> None:
    analysis = _analysis(_detections([(40.0, 20)]), add=_LONG_AXES[:1])
    (notice,) = (
        warning
        for warning in analysis.estimate.warnings
        if warning.code == NoticeCode.ADDED_VEHICLE_UNLIKE
    )
    assert "3.2 times as long as the 20 others: a lorry?" in notice.message


def test_added_vehicles_lead_few_others() -> None:
    analysis = _analysis(_detections([(40.0, 2)]), add=_LONG_AXES)
    assert analysis.estimate.mode_length_px == pytest.approx(132, rel=0.05)


def test_added_vehicles_lead_if_the_others_are_dropped() -> None:
    analysis = _analysis(_detections([(40.0, 20)]), drop=[*range(1, 21)], add=_LONG_AXES)
    assert analysis.estimate.mode_length_px == pytest.approx(132, rel=0.05)


def test_an_added_vehicle_counts() -> None:
    estimate = _analysis(_TWELVE, drop=[12], add=[(3000, 3000, 3024, 3032)]).estimate
    assert estimate.n_vehicles == 12
    assert estimate.details.by_hand is not None
    assert estimate.details.by_hand.model_dump() == {"dropped": 1, "added": 1}


def test_an_added_vehicle_has_the_next_number() -> None:
    detections = _corrected(_TWELVE, drop=[12], add=[(3000, 3000, 3024, 3032)])
    assert detections.numbers.tolist() == [*range(1, 12), 13]


def test_the_box_of_an_added_vehicle_follows_from_its_axis() -> None:
    detections = _corrected(_TWELVE, add=[(3000, 3000, 3024, 3032)])
    x, y, length, width, angle = detections.boxes[-1]
    assert (x, y, length) == pytest.approx((3012, 3016, 40))
    assert (width, angle) == pytest.approx((40 / 2.21, np.arctan2(4, 3)))


def test_an_added_vehicle_replaces_the_detections_that_it_overlaps() -> None:
    x, y = _TWELVE.boxes[3, :2]
    detections = _corrected(_TWELVE, add=[(x - 22, y, x + 22, y)])
    assert detections.numbers.tolist() == [1, 2, 3, *range(5, 14)]


def test_a_vehicle_that_is_added_twice_is_refused() -> None:
    x, y = _TWELVE.boxes[3, :2]
    with pytest.raises(InvalidParameterError, match="add 1 and add 2 are one vehicle"):
        _corrected(_TWELVE, add=[(x - 22, y, x + 22, y), (x - 20, y, x + 23, y)])


def test_an_added_vehicle_of_a_coarse_copy_is_less_certain() -> None:
    axis = np.array([3000, 3000, 3040, 3000])
    fine = _corrected(_TWELVE, add=[axis])
    coarse = _corrected(_TWELVE, add=[axis / 4], frame=(_SIDE // 4, _SIDE // 4))
    assert fine.boxes == pytest.approx(coarse.boxes)
    assert fine.corrections is not None
    assert coarse.corrections is not None
    fine_sd = fine.corrections.pointed_log_sds[-1]
    assert fine_sd == pytest.approx(np.sqrt(2) * 2 / 40)
    assert coarse.corrections.pointed_log_sds[-1] == pytest.approx(4 * fine_sd)
    assert not fine.corrections.pointed_log_sds[:-1].any()


# --- Corrections that are refused


def test_corrections_of_a_folder_are_refused(tmp_path: Path) -> None:
    options = ScaleOptions.of({"add": [(0, 0, 9, 0)]})
    with pytest.raises(InvalidParameterError, match="add belongs to one image"):
        run_batch([str(tmp_path)], tmp_path / "t.csv", options=options)


def test_corrections_without_a_search_are_refused(detector: Detector) -> None:
    with pytest.raises(InvalidParameterError, match="drop needs the ruler vehicles"):
        Engine(detector).estimate(blank_image(100, 80), rulers=("known_length",), drop=[1])


def test_corrections_beside_a_stated_scale_are_refused(detector: Detector) -> None:
    line = [(0, 0), (50, 0)]
    with pytest.raises(InvalidParameterError, match="give gsd_m_per_px or drop, not both"):
        Engine(detector).measure_distance(blank_image(100, 80), line, gsd_m_per_px=0.1, drop=[1])
