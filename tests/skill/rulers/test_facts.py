"""Facts of a caller: nothing that is repeated or guessed makes a scale sure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.analyses import analyse_found, made_card
from tests.skill.rulers.test_answers import CARS_GSD, VOTES, record_of
from tests.skill.rulers.test_camera import MAVIC, TRUE_GSD
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.standards import lengths_of

# A line of 1,000 px, across an image of 4000 x 3000 px.
Line = tuple[float, float, float, float]
LINE: Line = (100, 100, 1100, 100)
WRONG = 1.5  # Factor of a wrong fact.


def _measured(line: Line, gsd: float, basis: str = "measured") -> tuple[Any, ...]:
    """Give a line the length that a scale makes it."""
    x1, y1, x2, y2 = line
    return (x1, y1, x2, y2, gsd * math.dist((x1, y1), (x2, y2)), basis)


def _parts(line: Line, n: int) -> list[Line]:
    """Cut a line into equal parts."""
    x1, y1, x2, y2 = line
    cuts = [(x1 + (x2 - x1) * k / n, y1 + (y2 - y1) * k / n) for k in range(n + 1)]
    return [(*cuts[k], *cuts[k + 1]) for k in range(n)]


def _shifted(line: Line, across: float) -> Line:
    x1, y1, x2, y2 = line
    return (x1 + across, y1 + across, x2 + across, y2 + across)


def _swapped(line: Line) -> Line:
    x1, y1, x2, y2 = line
    return (x2, y2, x1, y1)


def _codes(record: GsdEstimate) -> list[str]:
    return [warning.code for warning in record.warnings]


REPETITIONS = {
    "three parts": _parts(LINE, 3),
    "sixteen parts": _parts(LINE, 16),
    "twice": [LINE, LINE],
    "shifted": [LINE, _shifted(LINE, 0.5)],
    "swapped": [LINE, _swapped(LINE)],
}


@pytest.mark.parametrize("lines", REPETITIONS.values(), ids=REPETITIONS)
@pytest.mark.parametrize("basis", ["measured", "assumed"])
def test_a_line_that_is_repeated_counts_once(lines: list[Line], basis: str) -> None:
    once = record_of(30, known_lengths=[_measured(LINE, WRONG * CARS_GSD, basis)])
    repeated = record_of(
        30, known_lengths=[_measured(line, WRONG * CARS_GSD, basis) for line in lines]
    )
    assert repeated.confidence == pytest.approx(once.confidence, abs=0.01)
    assert repeated.gsd_m_per_px == pytest.approx(once.gsd_m_per_px, rel=0.01)


def test_three_lines_with_one_mistake_do_not_outvote_the_cars() -> None:
    """One tape, one plan or one mistaken unit makes all of them wrong."""
    lines: list[Line] = [LINE, (100, 900, 1100, 900), (500, 100, 500, 1100)]
    record = record_of(171, known_lengths=[_measured(line, WRONG * CARS_GSD) for line in lines])
    wrong = WRONG * CARS_GSD
    assert not (record.status == "ok" and record.gsd_m_per_px == pytest.approx(wrong, rel=0.1))
    assert "rulers_disagree" in _codes(record)


def test_two_right_measured_lines_lead_and_are_surer_than_one() -> None:
    line = _measured(LINE, CARS_GSD)
    other = _measured((100, 900, 1100, 1400), CARS_GSD)
    one = record_of(0, known_lengths=[line])
    two = record_of(0, known_lengths=[line, other])
    assert (one.status, two.status, two.leading_ruler) == ("ok", "ok", "known_length")
    assert two.confidence >= one.confidence
    assert _log_width(two) < _log_width(one)


def _log_width(record: GsdEstimate) -> float:
    assert record.gsd_ci95_low_m_per_px is not None
    assert record.gsd_ci95_high_m_per_px is not None
    return math.log(record.gsd_ci95_high_m_per_px / record.gsd_ci95_low_m_per_px)


@pytest.mark.slow
@given(
    gsd=st.floats(0.05, 0.2),
    n_parts=st.integers(1, 6),
    across=st.floats(-0.7, 0.7),
    swap=st.booleans(),
    basis=st.sampled_from(["measured", "assumed"]),
)
def test_no_repetition_of_a_line_makes_a_scale_surer(
    gsd: float, n_parts: int, across: float, swap: bool, basis: str
) -> None:
    once = record_of(12, known_lengths=[_measured(LINE, gsd, basis)])
    lines = _parts(_shifted(LINE, across), n_parts)
    if swap:
        lines = [_swapped(line) for line in lines]
    repeated = record_of(12, known_lengths=[_measured(line, gsd, basis) for line in [LINE, *lines]])
    _check_no_surer(repeated, once)


def _check_no_surer(repeated: GsdEstimate, once: GsdEstimate) -> None:
    """The chance does not rise, and the value stays in the interval."""
    assert repeated.confidence <= once.confidence + 0.01
    assert once.gsd_ci95_low_m_per_px is not None
    assert once.gsd_ci95_high_m_per_px is not None
    assert repeated.gsd_m_per_px is not None
    low = 0.99 * once.gsd_ci95_low_m_per_px
    high = 1.01 * once.gsd_ci95_high_m_per_px
    assert low <= repeated.gsd_m_per_px <= high


@pytest.mark.slow
@given(
    gsd=st.floats(0.09, 0.11),
    n_steps=st.sampled_from([1, 2, 4]),
    basis=st.sampled_from(["measured", "assumed"]),
)
def test_a_smaller_copy_makes_no_line_surer(gsd: float, n_steps: int, basis: str) -> None:
    """A line that contradicts the cars does so less, the less exactly it is drawn."""
    x1, y1, x2, y2, metres, _ = _measured(LINE, gsd, basis)
    in_copy = (x1 / n_steps, y1 / n_steps, x2 / n_steps, y2 / n_steps, metres, basis)
    frame = (4000 // n_steps, 3000 // n_steps)
    once = record_of(12, known_lengths=[(x1, y1, x2, y2, metres, basis)])
    _check_no_surer(record_of(12, known_lengths=[in_copy], frame=frame), once)


@pytest.mark.slow
@given(
    gsd=st.floats(0.05, 0.2),
    what=st.sampled_from(["tennis_court_length", "iso_container_40ft", "motorway_lane_width"]),
    n_copies=st.integers(2, 4),
    across=st.floats(-0.7, 0.7),
    swap=st.booleans(),
)
def test_no_repetition_of_a_named_thing_makes_a_scale_surer(
    gsd: float, what: str, n_copies: int, across: float, swap: bool
) -> None:
    _, variants = lengths_of(what)
    length_px = variants[0].metres / gsd
    line: Line = (100, 100, 100 + length_px, 100)
    again = _swapped(_shifted(line, across)) if swap else _shifted(line, across)
    once = record_of(12, known_lengths=[(*line, what)])
    copies = [(*line, what), *[(*again, what)] * (n_copies - 1)]
    _check_no_surer(record_of(12, known_lengths=copies), once)


@pytest.mark.slow
@given(factor=st.floats(0.5, 2.0), repeated=st.floats(0.985, 1.015))
def test_a_height_that_repeats_the_file_makes_no_scale_surer(
    factor: float, repeated: float
) -> None:
    camera = replace_height(factor * CARS_GSD / TRUE_GSD * (MAVIC.height_m or 0.0))
    once = record_of(12, camera=camera)
    given_height: dict[str, Any] = {
        "height_m": repeated * camera.height_m,
        "height_basis": "measured",
    }
    _check_no_surer(record_of(12, camera=camera, **given_height), once)


@pytest.mark.slow
@given(factor=st.floats(0.5, 2.0))
def test_a_scale_that_is_given_back_makes_no_scale_surer(factor: float) -> None:
    line = _measured(LINE, factor * CARS_GSD, "assumed")
    once = record_of(12, known_lengths=[line])
    given_back: dict[str, Any] = {"gsd_m_per_px": once.gsd_m_per_px, "gsd_basis": "assumed"}
    _check_no_surer(record_of(12, known_lengths=[line], **given_back), once)


@pytest.mark.parametrize("factor", [1.0, 1.019, 1.021, 1.1, 1.3, 2.0])
def test_a_guess_that_may_be_read_off_the_file_adds_next_to_nothing(factor: float) -> None:
    alone = record_of(0, camera=MAVIC)
    guess = record_of(
        0, camera=MAVIC, known_lengths=[_measured(LINE, factor * TRUE_GSD, "assumed")]
    )
    assert guess.confidence <= alone.confidence + 0.02


def test_a_measured_line_confirms_the_file() -> None:
    alone = record_of(0, camera=MAVIC)
    confirmed = record_of(0, camera=MAVIC, known_lengths=[_measured(LINE, TRUE_GSD)])
    assert confirmed.confidence > alone.confidence
    assert confirmed.status == "ok"


def test_two_measured_facts_of_one_caller_do_not_outvote_cars() -> None:
    """The file states the height above a hill, and the caller's facts follow from it."""
    wrong_gsd = 0.4 * CARS_GSD
    height_m = MAVIC.height_m or 0.0
    camera = replace_height(height_m * wrong_gsd / TRUE_GSD)
    record = record_of(
        171,
        camera=camera,
        height_m=0.96 * (camera.height_m or 0.0),
        height_basis="measured",
        known_lengths=[_measured(LINE, wrong_gsd)],
    )
    assert not (record.status == "ok" and record.gsd_m_per_px == pytest.approx(wrong_gsd, rel=0.2))


def test_a_right_line_and_a_right_height_correct_the_file() -> None:
    camera = replace_height((MAVIC.height_m or 0.0) * 0.4 * CARS_GSD / TRUE_GSD)
    record = record_of(
        171,
        camera=camera,
        height_m=(MAVIC.height_m or 0.0) * CARS_GSD / TRUE_GSD,
        height_basis="measured",
        known_lengths=[_measured(LINE, CARS_GSD)],
    )
    assert (record.status, record.leading_ruler) == ("ok", "known_length")
    assert record.gsd_m_per_px == pytest.approx(CARS_GSD, rel=0.02)


def replace_height(height_m: float) -> Any:
    """Give the camera another height above take-off."""
    return replace(MAVIC, height_m=height_m)


def test_a_line_that_the_cars_exclude_is_named_and_covered() -> None:
    record = record_of(30, known_lengths=[_measured(LINE, 0.8 * CARS_GSD)])
    assert "rulers_disagree" in _codes(record)
    assert record.gsd_ci95_low_m_per_px is not None
    assert record.gsd_ci95_high_m_per_px is not None
    assert record.gsd_ci95_low_m_per_px < 0.8 * CARS_GSD
    assert record.gsd_ci95_high_m_per_px > CARS_GSD


def test_a_tape_a_few_percent_from_the_cars_is_no_contradiction() -> None:
    record = record_of(30, known_lengths=[_measured(LINE, 0.95 * CARS_GSD)])
    assert (record.status, _codes(record)) == ("ok", [])
    assert record.gsd_m_per_px == pytest.approx(0.95 * CARS_GSD, rel=0.01)


def test_a_pixel_pitch_of_an_unknown_camera_is_not_enough() -> None:
    """Programs that resize a picture keep its pitch and change its sizes."""
    unknown = replace(
        MAVIC, make="SONY", model="ILCE-0000", height_m=None, focal_35mm=None, pixel_mm=0.0015
    )
    record = record_of(0, camera=unknown, height_m=100.0, height_basis="measured")
    assert record.status == "low_confidence"
    known = replace(unknown, focal_35mm=28.4)
    assert record_of(0, camera=known, height_m=100.0, height_basis="measured").status == "ok"


@pytest.mark.parametrize("n", [2, 3, 9])
def test_any_number_of_guesses_is_not_usable(n: int) -> None:
    lines: list[Line] = [(100, 100 + 200 * k, 1100, 100 + 200 * k) for k in range(n)]
    record = record_of(0, known_lengths=[_measured(line, CARS_GSD, "assumed") for line in lines])
    assert record.status == "low_confidence"


def _guesses(kinds: str, factor: float) -> dict[str, Any]:
    """Make guesses that are wrong by one factor: reference length, line and height."""
    guesses: dict[str, Any] = {}
    if "length" in kinds:
        guesses["reference_length_m"] = factor * 5.0
    if "line" in kinds:
        guesses["known_lengths"] = [_measured(LINE, factor * CARS_GSD, "assumed")]
    if "height" in kinds:
        guesses["height_m"] = factor * CARS_GSD / TRUE_GSD * 100.0
        guesses["focal_35mm"] = 26.0
    return guesses


ALL_GUESSES = "length, line and height"


@pytest.mark.parametrize("cars", [1, 2, 5, 30, 171])
@pytest.mark.parametrize("factor", [1 / 2, 1 / 1.5, 1.5, 2])
@pytest.mark.parametrize("kinds", ["length and line", "length and height", ALL_GUESSES])
def test_wrong_guesses_do_not_make_each_other_sure(cars: int, factor: float, kinds: str) -> None:
    record = record_of(cars, **_guesses(kinds, factor))
    is_right = record.gsd_m_per_px == pytest.approx(CARS_GSD, rel=0.2)
    assert is_right or record.status != "ok"


@pytest.mark.parametrize("cars", [1, 3])
@pytest.mark.parametrize("factor", [1 / 1.3, 1.0, 1.3])
def test_a_guessed_length_of_cars_does_not_confirm_other_guesses(cars: int, factor: float) -> None:
    without = record_of(cars, **_guesses("line and height", factor))
    beside = record_of(cars, **_guesses(ALL_GUESSES, factor))
    assert beside.confidence <= without.confidence + 0.01


def test_a_guessed_length_of_cars_is_no_evidence_of_cars() -> None:
    """One box is a car, or another thing; a usual length of cars does not tell which."""
    alone = record_of(1)
    beside = record_of(1, reference_length_m=5.0)
    vehicles_alone = alone.rulers[0]
    vehicles_beside = beside.rulers[0]
    assert vehicles_beside.p_right <= vehicles_alone.p_right + 0.01


def test_the_kept_vehicles_are_those_whose_lengths_fit_the_answer() -> None:
    """A line and six long vehicles outweigh ten short ones, which are not cars."""
    analysis = _two_groups(CARS_GSD / 2)
    assert analysis.estimate.gsd_m_per_px == pytest.approx(CARS_GSD / 2, rel=0.05)
    assert analysis.kept.tolist() == [False] * 10 + [True] * 6
    assert analysis.estimate.n_vehicles == 6
    assert analysis.estimate.mode_length_px == pytest.approx(100, rel=0.01)


def _two_groups(line_gsd: float) -> ScaleAnalysis:
    """Ten vehicles of 50 px and six of 100 px, and a measured line."""
    lengths = np.array([50.0] * 10 + [100.0] * 6)
    rows = [(100.0 + 150 * k, 900.0, length, 0.4 * length, 0.0) for k, length in enumerate(lengths)]
    detections = Detections(np.array(rows), np.full(16, 0.95), reductions=np.ones(16))
    card = made_card(5.0).model_copy(update={"votes": VOTES})
    options = ScaleOptions.of({"known_lengths": [_measured(LINE, line_gsd)]})
    return analyse_found(detections, card, options, image_width_px=4000, image_height_px=3000)
