"""Records of photographs with several rulers: which leads, and which is doubted."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card, with_tilt
from tests.skill.rulers.test_camera import MAVIC
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.ruler import View
from vehanchor.scale.density import Votes

VOTES = Votes(share_at_zero=-13.76, share_slope=17.4)
CARS_GSD = 0.1  # of the cars of 50 px


def record_of(
    cars: int,
    car_px: float = 50.0,
    *,
    camera: CameraMetadata | None = None,
    votes: Votes | None = VOTES,
    stretch: float | None = None,
    **options: Any,
) -> GsdEstimate:
    """Analyse cars of 5 m in an image of 4000 x 3000 px."""
    factors = np.ones(cars)
    if cars > 1:
        factors = np.exp(0.08 * np.linspace(-1.5, 1.5, cars))
    boxes = [
        [99.0 + 90 * k, 90, car_px * factor, 0.4 * car_px, 0] for k, factor in enumerate(factors)
    ]
    found = Detections(
        np.array(boxes).reshape(-1, 5),
        np.full(cars, 0.95),
        reductions=None if stretch is None else np.ones(cars),
        n_tiles_total=1,
        stretch=stretch,
    )
    card = made_card(5.0).model_copy(update={"votes": votes, "reference_length_sd_m": 0.4})
    view = View(
        ImageFacts(4000, 3000, camera=camera),
        found,
        card=card,
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )
    return analyse_view(with_tilt(view)).estimate


def _lines(
    *scales: float, basis: str = "assumed", tolerance_m: float | None = None
) -> dict[str, Any]:
    return {
        "known_lengths": [
            (100, 100 * k + 100, 1100, 100 * k + 100, 1000 * gsd, basis, tolerance_m)
            for k, gsd in enumerate(scales)
        ]
    }


def _codes(record: GsdEstimate) -> list[str]:
    return [warning.code for warning in record.warnings]


def _right(record: GsdEstimate) -> dict[str, bool]:
    return {ruler.kind: ruler.p_right > 0.5 for ruler in record.rulers}


@pytest.mark.parametrize("cars", [1, 2, 4, 5, 30])
def test_the_status_follows_the_chance_for_any_number_of_cars(cars: int) -> None:
    record = record_of(cars)
    assert (record.status == "ok") == (record.confidence >= 0.9)
    assert record.details.composite_confidence is not None
    assert (record.details.composite_confidence < 0.5) == (cars < 5)  # the paper's


def test_more_cars_that_agree_are_a_better_chance() -> None:
    chances = [record_of(cars).confidence for cars in (1, 2, 4, 30)]
    assert chances == sorted(set(chances))
    assert chances[0] < 0.9 < chances[-1]


def test_vehicles_of_too_few_pixels_are_not_usable() -> None:
    record = record_of(300, car_px=8.0)
    assert (record.status, record.reason, record.details.resolution_guard) == (
        "low_confidence",
        "too_coarse",
        True,
    )


def test_a_single_car_asks_for_one_more() -> None:
    record = record_of(1)
    assert (record.status, record.reason) == ("low_confidence", "too_few")


@pytest.mark.parametrize("cars", [2, 30])
def test_a_stretched_photograph_is_not_usable(cars: int) -> None:
    record = record_of(cars, stretch=1.3)
    assert record.status == "low_confidence"
    assert "stretched" in _codes(record)
    assert record.confidence < record_of(cars, stretch=0.5).confidence


def test_the_vehicles_keep_the_papers_scale_beside_the_answer() -> None:
    record = record_of(30, **_lines(0.093, basis="measured"))
    vehicles = next(ruler for ruler in record.rulers if ruler.kind == "vehicles")
    assert vehicles.gsd_m_per_px == (record.details.reference_length_m or math.nan) / (
        record.mode_length_px or math.nan
    )
    assert record.gsd_m_per_px == pytest.approx(0.093, rel=0.01)


def test_with_other_rulers_at_hand_the_cars_alone_are_one_option_away() -> None:
    together = record_of(30, camera=MAVIC, **_lines(0.09))
    alone = record_of(30, camera=MAVIC, rulers=("vehicles",), **_lines(0.09))
    [unused] = alone.warnings
    assert unused.code == "fact_unused"
    assert alone.model_copy(update={"warnings": ()}) == record_of(30)
    assert together.gsd_m_per_px != alone.gsd_m_per_px
    assert together.n_vehicles == alone.n_vehicles
    assert together.mode_length_px == alone.mode_length_px


@pytest.mark.parametrize(
    ("options", "camera", "gsd", "source"),
    [
        (_lines(0.05, basis="measured"), None, 0.05, "known_length"),
        ({"height_m": 100.0, "focal_35mm": 26.0}, None, 0.0333, "height"),
        ({}, MAVIC, 0.0333, "camera"),
    ],
)
def test_without_a_car_the_other_ruler_makes_the_scale(
    options: dict[str, Any], camera: CameraMetadata | None, gsd: float, source: str
) -> None:
    record = record_of(0, camera=camera, **options)
    assert record.gsd_m_per_px == pytest.approx(gsd, rel=0.05)
    assert record.leading_ruler == source
    assert (record.n_vehicles, record.mode_length_px, record.details.working_scale) == (
        0,
        None,
        None,
    )
    (ruler,) = record.rulers
    assert record.gsd_ci95_low_m_per_px == pytest.approx(ruler.gsd_ci95_low_m_per_px, rel=0.02)
    assert record.gsd_ci95_high_m_per_px == pytest.approx(ruler.gsd_ci95_high_m_per_px, rel=0.02)


def test_a_loose_ruler_alone_is_not_usable() -> None:
    loose = record_of(0, camera=replace(MAVIC, off_nadir_deg=None))
    assert (loose.status, loose.reason) == ("low_confidence", "imprecise")


def test_a_height_above_the_sea_alone_is_no_scale() -> None:
    record = record_of(0, camera=replace(MAVIC, height_m=None, height_tag=""))
    assert (record.status, record.gsd_m_per_px, record.leading_ruler, record.rulers) == (
        "no_scale",
        None,
        None,
        (),
    )


@pytest.fixture(scope="module")
def one_wrong_of_three() -> GsdEstimate:
    """Cars and a camera at 0.033 m/px, and a measured line at 0.2."""
    return record_of(40, car_px=5.0 / 0.033, camera=MAVIC, **_lines(0.2, basis="measured"))


def test_one_wrong_ruler_of_three_does_not_move_the_scale(one_wrong_of_three: GsdEstimate) -> None:
    assert one_wrong_of_three.gsd_m_per_px == pytest.approx(0.033, rel=0.1)


def test_one_wrong_ruler_of_three_is_named(one_wrong_of_three: GsdEstimate) -> None:
    record = one_wrong_of_three
    assert _right(record) == {"vehicles": True, "camera": True, "known_length": False}
    (warning,) = record.warnings
    assert warning.code == "rulers_disagree"
    assert warning.message.startswith(
        "The known length gives 0.2 m/px, and all rulers together 0.03"
    )


def test_a_camera_far_from_the_cars_makes_the_scale_unusable() -> None:
    record = record_of(40, camera=MAVIC)  # the cars say 0.1, the camera 0.033
    assert (record.status, record.reason) == ("low_confidence", "disagree")
    assert "rulers_disagree" in _codes(record)


def test_a_height_that_repeats_the_files_changes_nothing() -> None:
    again: dict[str, Any] = {"height_m": (MAVIC.height_m or 0) * 1.01, "height_basis": "measured"}
    for cars in (0, 40):
        alone = record_of(cars, camera=MAVIC)
        repeated = record_of(cars, camera=MAVIC, **again)
        assert _codes(repeated).count("height_repeated") == 1
        assert repeated.confidence == alone.confidence
        assert repeated.gsd_m_per_px == alone.gsd_m_per_px
        assert repeated.rulers == alone.rulers


def test_an_assumed_line_that_contradicts_the_cars_lowers_the_chance() -> None:
    alone = record_of(30)
    beside = record_of(30, **_lines(2.2 * CARS_GSD))
    assert beside.confidence < alone.confidence
    assert _right(beside) == {"vehicles": True, "known_length": False}
    assert _codes(beside) == ["rulers_disagree"]


def test_an_assumed_line_that_agrees_raises_the_chance() -> None:
    alone = record_of(2)
    beside = record_of(2, **_lines(1.02 * CARS_GSD))
    assert beside.confidence > alone.confidence


def test_assumed_facts_alone_or_together_are_not_usable() -> None:
    height: dict[str, Any] = {"height_m": 150.0, "focal_35mm": 26.0}  # 0.05 m/px
    for options in (_lines(0.05), _lines(0.05, 0.051), height, _lines(0.05) | height):
        record = record_of(0, **options)
        assert (record.status, record.reason) == ("low_confidence", "assumed")


def test_a_measured_line_alone_is_usable() -> None:
    record = record_of(0, **_lines(0.05, basis="measured"))
    assert record.status == "ok"
    assert record.confidence >= 0.9


def test_a_measured_line_alone_is_never_certain() -> None:
    assert record_of(0, **_lines(0.05, basis="measured")).confidence <= 0.99


@pytest.mark.parametrize("factor", [1.15, 1 / 1.2])
def test_a_measured_line_near_the_cars_leads(factor: float) -> None:
    record = record_of(30, **_lines(factor * CARS_GSD, basis="measured"))
    assert record.gsd_m_per_px == pytest.approx(factor * CARS_GSD, rel=0.02)
    assert (record.status, record.leading_ruler) == ("ok", "known_length")


def test_one_measured_line_far_from_the_cars_makes_the_scale_unusable() -> None:
    one = record_of(30, **_lines(2.2 * CARS_GSD, basis="measured"))
    assert (one.status, one.reason) == ("low_confidence", "disagree")


def test_two_measured_lines_far_from_the_cars_do_not_lead() -> None:
    """One mistaken unit or plan makes all lines of a caller wrong."""
    two = record_of(30, **_lines(2.2 * CARS_GSD, 2.23 * CARS_GSD, basis="measured"))
    assert two.gsd_m_per_px == pytest.approx(CARS_GSD, rel=0.05)
    assert _right(two) == {"vehicles": True, "known_length": False}


def test_measured_lines_that_contradict_each_other_are_named() -> None:
    record = record_of(0, **_lines(CARS_GSD, 1.6 * CARS_GSD, basis="measured"))
    assert record.status == "low_confidence"
    assert "known_lengths_disagree" in _codes(record)


def test_a_height_five_times_that_of_the_cars_is_no_scale_to_use() -> None:
    for basis in ("assumed", "measured"):
        record = record_of(30, height_m=1500.0, height_basis=basis, focal_35mm=26.0)  # 0.5 m/px
        assert record.gsd_m_per_px == pytest.approx(CARS_GSD, rel=0.1)
        assert not _right(record)["height"]


def _record_with_wrong_unit(kind: str, basis: str, cars_gsd: float, factor: float) -> GsdEstimate:
    """Cars at one scale, and a line or a stated scale at a multiple of it."""
    gsd = factor * cars_gsd
    fact: dict[str, Any] = {"gsd_m_per_px": gsd, "gsd_basis": basis}
    if kind == "line":
        fact = _lines(gsd, basis=basis)
    return record_of(30, car_px=5 / cars_gsd, **fact)


@pytest.mark.parametrize("basis", ["assumed", "measured"])
@pytest.mark.parametrize(
    ("cars_gsd", "factor", "words"), [(0.02, 100, "not centimetres"), (1.0, 0.01, "give metres")]
)
@pytest.mark.parametrize("kind", ["line", "scale"])
def test_a_mistyped_unit_is_named(
    basis: str, cars_gsd: float, factor: float, words: str, kind: str
) -> None:
    record = _record_with_wrong_unit(kind, basis, cars_gsd, factor)
    messages = [warning.message for warning in record.warnings if warning.code == "unit_mistyped"]
    assert any(words in message for message in messages)


@pytest.mark.parametrize("basis", ["assumed", "measured"])
@pytest.mark.parametrize(("cars_gsd", "factor"), [(0.02, 100), (1.0, 0.01)])
@pytest.mark.parametrize("kind", ["line", "scale"])
def test_a_mistyped_unit_never_leads_a_usable_scale(
    basis: str, cars_gsd: float, factor: float, kind: str
) -> None:
    record = _record_with_wrong_unit(kind, basis, cars_gsd, factor)
    assert record.leading_ruler == "vehicles" or record.status != "ok"


def test_a_tolerance_is_the_interval_of_the_line() -> None:
    record = record_of(0, **_lines(0.05, basis="measured", tolerance_m=5.0))  # of 50 m
    low = record.gsd_ci95_low_m_per_px
    high = record.gsd_ci95_high_m_per_px
    assert low is not None
    assert high is not None
    assert math.log(high / low) == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize(("cars", "status"), [(60, "ok"), (3, "low_confidence")])
def test_the_preset_paper_acts_on_the_composite_alone(cars: int, status: str) -> None:
    record = record_of(cars, preset="paper")
    assert record.confidence == record.details.composite_confidence
    assert record.status == status
    assert (record.confidence >= 0.5) == (status == "ok")
    assert record.gsd_m_per_px == (record.details.reference_length_m or math.nan) / (
        record.mode_length_px or math.nan
    )


def test_a_line_given_twice_counts_once() -> None:
    lines = _lines(0.05)["known_lengths"]
    once = record_of(0, known_lengths=lines)
    twice = record_of(0, known_lengths=lines * 2)
    assert twice.confidence == once.confidence
    assert twice.gsd_m_per_px == once.gsd_m_per_px
