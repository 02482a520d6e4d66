"""Remedies are ranked by what the posterior would be with them."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.raster import RasterNote
from vehanchor.options import ScaleOptions
from vehanchor.records import ExpectedGain, GsdEstimate, Remedy
from vehanchor.records.advice import advice_for
from vehanchor.rulers.ruler import View
from vehanchor.scale.defaults import USABLE_CHANCE

GSD = 0.15


def _estimate(
    n_cars: int, score: float = 0.8, notices: tuple[str, ...] = (), **options: Any
) -> GsdEstimate:
    boxes = np.array([[90.0 + 80 * k, 90.0, 32.0, 13.0, 0.0] for k in range(n_cars)])
    found = Detections(boxes.reshape(-1, 5), np.full(n_cars, score))
    notes = tuple(RasterNote(code, "A doubt.") for code in notices)
    view = View(
        ImageFacts(600, 400, notices=notes),
        found,
        card=made_card(),
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )
    return analyse_view(view).estimate


def _gains(estimate: GsdEstimate) -> dict[Remedy, ExpectedGain]:
    return {gain.remedy: gain for gain in estimate.details.remedies}


def _line(metres: float | str, basis: str = "assumed") -> tuple[Any, ...]:
    return (100, 200, 400, 200, metres, basis)


def test_a_usable_scale_has_no_remedies() -> None:
    assert _estimate(5).status == "ok"
    assert _estimate(5).details.remedies == ()


def test_remedies_that_lead_to_a_usable_scale_come_first_by_its_width() -> None:
    gains = _estimate(1).details.remedies
    leading = [gain for gain in gains if gain.confidence >= USABLE_CHANCE]
    widths = [gain.gsd_ci95_ratio for gain in leading]
    assert gains[: len(leading)] == tuple(leading)
    assert widths == sorted(widths)


def test_a_measured_length_narrows_the_interval_more_than_a_height() -> None:
    gains = _gains(_estimate(0))
    assert gains["length"].gsd_ci95_ratio < gains["height"].gsd_ci95_ratio


def test_the_expected_confidence_is_that_of_the_remedy() -> None:
    expected = _gains(_estimate(1))["length"].confidence
    gsd = _estimate(1).gsd_m_per_px
    assert gsd is not None
    followed = _estimate(1, known_lengths=[_line(300 * gsd, "measured")])
    assert abs(followed.confidence - expected) < 0.02


def test_a_region_is_no_remedy_where_the_caller_named_it() -> None:
    assert "region" in _gains(_estimate(1))
    assert "region" not in _gains(_estimate(1, region="JP"))


def test_further_assumed_lines_are_no_remedy_after_two() -> None:
    lines = [_line(45.0), (100, 300, 400, 300, 45.0, "assumed")]
    estimate = _estimate(0, known_lengths=lines)
    advice = advice_for(estimate)
    assert advice is not None
    assert "things" not in advice.remedies
    assert "will not help" in advice.why


def test_doubtful_vehicles_that_a_measured_line_contradicts_are_named() -> None:
    line = _line(300 * GSD * 0.6, "measured")
    advice = advice_for(_estimate(2, score=0.4, known_lengths=[line]))
    assert advice is not None
    assert advice.remedies[:2] == ("facts", "drop")
    assert advice.vehicles == (1, 2)


def test_no_line_helps_an_image_that_is_stretched() -> None:
    estimate = _estimate(3, notices=("stretched",))
    advice = advice_for(estimate)
    assert estimate.reason == "disagree"
    assert advice is not None
    assert advice.remedies == ("original", "aspect")
