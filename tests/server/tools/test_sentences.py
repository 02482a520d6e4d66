from __future__ import annotations

import typing

import numpy as np
import pytest

from tests.analyses import make_analysis
from vehanchor.records import GsdEstimate, Notice
from vehanchor.scale.confidence import FleetDoubt
from vehanchor_server.tools.sentences import describe_estimate


@pytest.fixture
def doubtful() -> GsdEstimate:
    """An estimate from three vehicles."""
    boxes = np.array([[x, 50.0, 30.0, 12.0, 0.0] for x in (50.0, 150.0, 250.0)])
    estimate = make_analysis(boxes, 400, 300).estimate
    assert estimate.status == "low_confidence"
    return estimate


def test_few_vehicles_are_too_little_evidence(doubtful: GsdEstimate) -> None:
    assert "from 3 vehicles: do not rely on it (too little evidence); fall back" in describe_estimate(doubtful)


def test_a_single_vehicle_is_counted_in_the_singular(doubtful: GsdEstimate) -> None:
    assert "from 1 vehicle: " in describe_estimate(doubtful.model_copy(update={"n_vehicles": 1}))


def test_the_guard_is_told_as_what_it_means(doubtful: GsdEstimate) -> None:
    guarded = doubtful.model_copy(update={"resolution_guard": True})
    assert "(vehicles show too little detail to be measured well)" in describe_estimate(guarded)


@pytest.mark.parametrize("code", typing.get_args(FleetDoubt))
def test_doubts_about_the_fleet_are_told_with_their_warning(doubtful: GsdEstimate, code: str) -> None:
    notice = Notice(code=code, message="They are all alike.")
    words = describe_estimate(doubtful.model_copy(update={"warnings": (notice,)}))
    assert "(the vehicles may not be cars)" in words
    assert words.endswith(f"Warning {code}: They are all alike.")


@pytest.mark.parametrize(("gsd", "words"), [(0.15234, "0.152 m/px"), (12.345, "12.3 m/px"), (1234.5, "1234 m/px")])
def test_numbers_have_three_digits_and_no_exponent(doubtful: GsdEstimate, gsd: float, words: str) -> None:
    assert describe_estimate(doubtful.model_copy(update={"gsd_m_per_px": gsd})).startswith(words)
