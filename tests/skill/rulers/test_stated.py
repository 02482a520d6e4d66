"""Stated facts beside cars: measured ones lead, assumed ones are weighed, a contradiction never raises confidence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.skill.rulers.test_decision import VOTES, _record
from vehanchor.records import GsdEstimate

CARS_GSD = 0.1  # of the cars of 50 px


def _lines(*scales: float, basis: str = "assumed", tolerance_m: float | None = None) -> dict[str, Any]:
    return {
        "known_lengths": [
            (100, 100 * k + 100, 1100, 100 * k + 100, 1000 * gsd, basis, tolerance_m) for k, gsd in enumerate(scales)
        ]
    }


def _codes(record: GsdEstimate) -> list[str]:
    return [warning.code for warning in record.warnings]


def test_an_assumed_line_that_contradicts_the_cars_lowers_the_confidence_and_is_not_usable() -> None:
    alone, beside = _record(30), _record(30, **_lines(2.2 * CARS_GSD))
    assert beside.confidence < alone.confidence
    assert (beside.status, beside.reason) == ("low_confidence", "disagree")
    assert _codes(beside) == ["rulers_disagree"]
    assert beside.p_within_20 is not None
    assert beside.p_within_20 <= 0.5


def test_an_assumed_line_that_agrees_raises_the_confidence() -> None:
    alone, beside = _record(12), _record(12, **_lines(1.02 * CARS_GSD))
    assert beside.confidence > alone.confidence
    assert beside.status == "ok"


def test_an_assumed_line_alone_is_not_usable_and_two_that_agree_are() -> None:
    one, two = _record(0, **_lines(0.05)), _record(0, **_lines(0.05, 0.051))
    assert (one.status, one.reason) == ("low_confidence", "assumed")
    assert two.status == "ok"
    assert two.p_within_20 is not None
    assert two.p_within_20 <= 0.99


def test_a_measured_line_alone_is_usable_and_never_certain() -> None:
    record = _record(0, **_lines(0.05, basis="measured"))
    assert record.status == "ok"
    assert 0.9 <= record.confidence <= 0.99


@pytest.mark.parametrize("factor", [1.26, 1 / 1.26, 1.45])
def test_a_measured_line_leads_within_the_factor_and_the_cars_are_named(factor: float) -> None:
    record = _record(30, **_lines(factor * CARS_GSD, basis="measured"))
    assert record.gsd_m_per_px == pytest.approx(factor * CARS_GSD, rel=0.01)
    assert (record.status, record.leading_ruler) == ("ok", "known_length")
    alone = _record(0, **_lines(factor * CARS_GSD, basis="measured"))
    assert record.confidence == pytest.approx(alone.confidence, abs=0.01)
    assert {ruler.kind: ruler.agrees for ruler in record.rulers} == {"vehicles": False, "known_length": True}
    (warning,) = record.warnings
    assert warning.message.endswith("The measured fact leads.")


def test_a_measured_line_beyond_the_factor_is_asked_about_and_two_lead() -> None:
    one = _record(30, **_lines(2.2 * CARS_GSD, basis="measured"))
    assert (one.status, one.reason) == ("low_confidence", "disagree")
    assert {ruler.kind for ruler in one.rulers} == {"vehicles", "known_length"}
    two = _record(30, **_lines(2.2 * CARS_GSD, 2.23 * CARS_GSD, basis="measured"))
    assert two.status == "ok"
    assert two.gsd_m_per_px == pytest.approx(2.2 * CARS_GSD, rel=0.02)


def test_a_measured_height_and_line_that_agree_lead_at_any_factor() -> None:
    height: dict[str, Any] = {"height_m": 800.0, "height_basis": "measured", "focal_35mm": 26.0}  # 0.266 m/px
    record = _record(30, **_lines(0.265, basis="measured"), **height)
    assert record.status == "ok"
    assert record.gsd_m_per_px == pytest.approx(0.265, rel=0.02)


def test_measured_lines_that_contradict_each_other_are_not_usable() -> None:
    record = _record(30, **_lines(CARS_GSD, 1.6 * CARS_GSD, basis="measured"))
    assert (record.status, record.reason) == ("low_confidence", "disagree")
    assert "known_lengths_disagree" in _codes(record)


def test_a_height_five_times_that_of_the_cars_is_no_scale_to_use() -> None:
    for basis in ("assumed", "measured"):
        record = _record(30, height_m=1500.0, height_basis=basis, focal_35mm=26.0)  # 0.5 m/px
        assert (record.status, record.reason) == ("low_confidence", "disagree")


@pytest.mark.parametrize("basis", ["assumed", "measured"])
@pytest.mark.parametrize(("cars_gsd", "factor", "words"), [(0.02, 100, "not centimetres"), (1.0, 0.01, "give metres")])
def test_a_mistyped_unit_is_told_and_does_not_lead(basis: str, cars_gsd: float, factor: float, words: str) -> None:
    record = _record(30, car_px=5 / cars_gsd, **_lines(factor * cars_gsd, basis=basis))
    assert "unit_mistyped" in _codes(record)
    assert any(words in warning.message for warning in record.warnings if warning.code == "unit_mistyped")
    assert record.status == "low_confidence"


def test_a_tolerance_is_the_interval_of_the_line() -> None:
    record = _record(0, **_lines(0.05, basis="measured", tolerance_m=5.0))  # of 50 m
    low, high = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
    assert low is not None
    assert high is not None
    assert math.log(high / low) == pytest.approx(0.2, rel=0.05)


def test_cars_that_are_no_cars_do_not_stop_a_measured_line() -> None:
    record = _record(1, **_lines(0.3, basis="measured"))
    assert record.status == "ok"
    assert record.gsd_m_per_px == pytest.approx(0.3, rel=0.01)


DRAWS = 1000


@pytest.mark.slow
def test_liars_among_cars_and_assumed_facts_are_not_acted_on() -> None:
    """Cars, two assumed lines and a measured one, of which cars or an assumed line lie by at least half."""
    rng = np.random.default_rng(30)
    near = wrong = 0
    for _ in range(DRAWS):
        gsd = math.exp(rng.uniform(math.log(0.03), math.log(0.25)))
        liar = int(rng.integers(3))
        told = [gsd * math.exp(rng.normal(0, spread)) for spread in (0.05, 0.08, 0.08)]
        told[liar] *= math.exp(rng.choice([-1, 1]) * rng.uniform(math.log(1.5), math.log(5)))
        record = _record(30, car_px=5.0 / told[0], votes=VOTES, **_lines(*told[1:]))
        error = abs((record.gsd_m_per_px or 1e9) / gsd - 1)
        near += error < 0.1
        wrong += record.status == "ok" and error >= 0.2
    assert near / DRAWS >= 0.9
    assert wrong / DRAWS <= 0.005
