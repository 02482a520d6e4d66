from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor_flight.live.filter import FilterState, Measurement, Motion, corrected, predicted, started

LOGS = st.floats(-5.0, 0.5)
SDS = st.floats(0.01, 0.3)
CHANCES = st.floats(0.05, 0.999)
MEASUREMENTS = st.builds(Measurement, LOGS, SDS, SDS, CHANCES)
MOTIONS = st.builds(Motion, st.floats(-0.5, 0.5), st.floats(0.001, 0.1), st.floats(0.0, 1.0))
SURE = Measurement(math.log(0.1), 0.05, 0.04, 0.95)


@given(MEASUREMENTS, MOTIONS, st.floats(0, 1))
def test_a_motion_moves_the_scale_by_its_ratio_and_never_makes_it_surer(
    measured: Measurement, motion: Motion, seconds: float
) -> None:
    before = started(measured)
    after = predicted(before, seconds, motion)
    assert after is not None
    assert after.log_gsd == pytest.approx(before.log_gsd + motion.log_ratio)
    assert after.variance > before.variance


@given(MEASUREMENTS, st.floats(0.1, 1.0))
def test_frames_without_common_features_widen_more_than_any_linked_ones(measured: Measurement, seconds: float) -> None:
    before = started(measured)
    linked = predicted(before, seconds, Motion(0.0, 0.02, 1.0))
    apart = predicted(before, seconds, None)
    assert linked is not None
    assert apart is None or apart.variance > linked.variance


@given(MEASUREMENTS, MEASUREMENTS, st.floats(0, 1))
def test_a_correction_lies_between_state_and_measurement_or_starts_anew(
    first: Measurement, second: Measurement, moved: float
) -> None:
    state = predicted(started(first), 0.2, Motion(0.0, 0.01, moved))
    assert state is not None
    after = corrected(state, second)
    low, high = sorted((state.log_gsd, second.log_gsd))
    assert low - 1e-9 <= after.log_gsd <= high + 1e-9
    assert after.variance <= state.variance + 1e-12
    assert after.log_sd >= after.common_log_sd
    assert 0 <= after.chance <= 1


@given(st.lists(st.tuples(MEASUREMENTS, st.none() | MOTIONS), max_size=30))
def test_whatever_comes_the_state_is_sound(steps: list[tuple[Measurement, Motion | None]]) -> None:
    state: FilterState | None = None
    for measured, motion in steps:
        if state is not None:
            state = predicted(state, 0.2, motion)
        state = corrected(state, measured)
        assert all(map(math.isfinite, state))
        assert state.variance > 0
        low, high = state.interval
        assert low < state.gsd_m_per_px < high
        assert 0 <= state.chance < 0.99


def test_hovering_over_the_same_cars_does_not_narrow_the_interval() -> None:
    state = hovering = started(SURE)
    flown = started(SURE)
    for _ in range(20):
        hovering = corrected(predicted(hovering, 0.2, Motion(0.0, 0.01, 0.0)), SURE)
        flown = corrected(predicted(flown, 0.2, Motion(0.0, 0.01, 1.0)), SURE)
    assert hovering.log_sd > 0.85 * state.log_sd
    assert flown.log_sd < 0.85 * state.log_sd
    assert flown.log_sd > SURE.common_log_sd


def test_more_cars_over_the_same_ground_narrow_it_as_if_seen_at_once() -> None:
    few, many = SURE._replace(log_sd=0.2), SURE._replace(log_sd=0.03)
    state = corrected(started(few), many)
    assert math.sqrt(state.variance) == pytest.approx(0.03, rel=0.05)


def test_one_contradiction_takes_the_ok_away_and_three_start_anew() -> None:
    state = started(SURE)
    assert state.usable
    other = SURE._replace(log_gsd=math.log(0.2))
    once = corrected(state, other)
    assert not once.usable
    assert once.gsd_m_per_px == pytest.approx(0.1)
    assert corrected(once, SURE).contradictions == 0
    anew = corrected(corrected(once, other), other)
    assert anew.gsd_m_per_px == pytest.approx(0.2)
    assert anew.contradictions == 0


def test_without_any_link_the_scale_ends_in_seconds() -> None:
    state: FilterState | None = started(SURE)
    seconds = 0.0
    while state is not None:
        state, seconds = predicted(state, 0.5, None), seconds + 0.5
        assert state is None or seconds < 0.5 or not state.usable
    assert 1 < seconds < 30


@pytest.mark.parametrize("chance", [0.3, 0.7])
def test_doubtful_frames_of_new_ground_that_agree_become_sure_only_if_likely(chance: float) -> None:
    measured = SURE._replace(chance=chance)
    state = started(measured)
    assert not state.usable
    for _ in range(6):
        state = corrected(predicted(state, 0.2, Motion(0.0, 0.01, 1.0)), measured)
    assert state.usable == (chance > 0.5)
