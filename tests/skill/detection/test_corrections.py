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

_SIDE = 4000


def _found(
    groups: list[tuple[float, int]],
    *,
    score: float = 0.8,
    appearance: Appearance | None = None,
    spread: float = 0.07,
) -> Detections:
    """Groups of (length, number), spread as a fleet, in rows of their own."""
    boxes = [
        [
            50 + 99.0 * k,
            100.0 * row,
            length * (1 + spread * NormalDist().inv_cdf((k + 0.5) / n)),
            length / 2.2,
            0.0,
        ]
        for row, (length, n) in enumerate(groups, 1)
        for k in range(n)
    ]
    n = len(boxes)
    return Detections(
        np.array(boxes).reshape(-1, 5),
        np.full(n, score),
        reductions=np.ones(n),
        appearance=appearance,
    )


def _corrected(found: Detections, **told: Any) -> Detections:
    options = ScaleOptions.of(told).in_pixels(_SIDE, _SIDE)
    return corrected(found, options.by_hand, options.frame, (_SIDE, _SIDE), options.search.nms_iou)


def _analysis(found: Detections, **told: Any) -> ScaleAnalysis:
    made = _corrected(found, **told)
    return analyse_found(
        made, made_card(), ScaleOptions(), image_width_px=_SIDE, image_height_px=_SIDE
    )


def test_without_corrections_nothing_changes() -> None:
    found = _found([(40.0, 12)])
    assert _corrected(found) is found
    assert _analysis(found).estimate.details.by_hand is None
    assert found.numbers.tolist() == list(range(1, 13))


def test_dropped_vehicles_are_no_evidence_and_the_others_keep_their_numbers() -> None:
    found = _found([(40.0, 12), (100.0, 10)])
    both = _analysis(found)
    one = _analysis(found, drop=range(13, 23))
    alone = _analysis(_found([(40.0, 12)]))
    assert both.estimate.confidence < one.estimate.confidence
    assert one.estimate.warnings == ()
    details = one.estimate.details.model_copy(update={"by_hand": None})
    assert one.estimate.model_copy(update={"details": details}) == alone.estimate
    assert one.estimate.details.by_hand is not None
    assert one.estimate.details.by_hand.dropped == 10
    some = _analysis(found, drop=[1, 3])
    assert some.detections.numbers.tolist() == [2, *range(4, 23)]
    assert [each["properties"]["number"] for each in some.__geo_interface__["features"]][:2] == [
        2,
        4,
    ]


def test_added_vehicles_choose_the_fleet_and_pass_the_outlier_filter() -> None:
    found = _found([(40.0, 20)])
    told = _analysis(found, add=[(3000, y, 3100 + y / 100, y) for y in (3000, 3200, 3400)])
    assert told.estimate.mode_length_px == pytest.approx(132, rel=0.05)
    assert told.kept.tolist() == [False] * 20 + [True] * 3


def test_an_added_vehicle_counts_and_has_the_next_number() -> None:
    found = _found([(40.0, 12)])
    told = _analysis(found, drop=[12], add=[(3000, 3000, 3024, 3032)])
    assert told.detections.numbers.tolist() == [*range(1, 12), 13]
    x, y, length, width, angle = told.detections.boxes[-1]
    assert (x, y, length) == pytest.approx((3012, 3016, 40))
    assert (width, angle) == pytest.approx((40 / 2.21, np.arctan2(4, 3)))
    assert told.estimate.n_vehicles == 12
    assert told.estimate.details.by_hand is not None
    assert told.estimate.details.by_hand.model_dump() == {"dropped": 1, "added": 1}


def test_an_added_vehicle_replaces_the_detections_that_it_overlaps() -> None:
    found = _found([(40.0, 12)])
    x, y = found.boxes[3, :2]
    told = _corrected(found, add=[(x - 22, y, x + 22, y)])
    assert told.numbers.tolist() == [1, 2, 3, *range(5, 14)]
    with pytest.raises(InvalidParameterError, match="add 1 and add 2 are one vehicle"):
        _corrected(found, add=[(x - 22, y, x + 22, y), (x - 20, y, x + 23, y)])


def test_an_added_vehicle_of_a_coarse_copy_is_less_certain() -> None:
    found = _found([(40.0, 12)])
    axis = np.array([3000, 3000, 3040, 3000])
    fine = _corrected(found, add=[axis])
    coarse = _corrected(found, add=[axis / 4], frame=(_SIDE // 4, _SIDE // 4))
    assert fine.boxes == pytest.approx(coarse.boxes)
    assert fine.corrections is not None
    assert coarse.corrections is not None
    assert fine.corrections.pointed_log_sds[-1] == pytest.approx(np.sqrt(2) * 2 / 40)
    assert coarse.corrections.pointed_log_sds[-1] == pytest.approx(
        4 * fine.corrections.pointed_log_sds[-1]
    )
    assert not fine.corrections.pointed_log_sds[:-1].any()


def test_a_number_that_does_not_exist_says_how_many_there_are() -> None:
    with pytest.raises(
        InvalidParameterError, match=r"drop has number 13, which is not a vehicle .* are 1 to 12"
    ):
        _corrected(_found([(40.0, 12)]), drop=[2, 13])
    with pytest.raises(InvalidParameterError, match="no vehicle was found"):
        _corrected(_found([]), drop=[1])


def test_what_belongs_to_one_image_or_needs_a_search_is_refused(
    detector: Detector, tmp_path: Path
) -> None:
    engine = Engine(detector)
    image = blank_image(100, 80)
    with pytest.raises(InvalidParameterError, match="add belongs to one image"):
        run_batch(
            [str(tmp_path)], tmp_path / "t.csv", options=ScaleOptions.of({"add": [(0, 0, 9, 0)]})
        )
    with pytest.raises(InvalidParameterError, match="drop needs the ruler vehicles"):
        engine.estimate(image, rulers=("known_length",), drop=[1])
    with pytest.raises(InvalidParameterError, match="give gsd_m_per_px or drop, not both"):
        engine.measure_distance(image, [(0, 0), (50, 0)], gsd_m_per_px=0.1, drop=[1])
