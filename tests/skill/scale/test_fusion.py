from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.scale.fusion import (
    GRID,
    LOG_STEP,
    USABLE_CHANCE,
    Votes,
    blurred,
    credible_interval,
    flat,
    fuse,
    mass_within,
    product,
    recalibrated,
    vehicle_density,
    with_outlier_floor,
)

_VOTES = Votes(-2.0, 5.0, log_sd=0.12, clutter_density=0.3, trust=1.0, chance_wrong=1e-9)


def _normal(gsd: float, log_sd: float) -> np.ndarray:
    density = np.exp(-0.5 * ((GRID - np.log(gsd)) / log_sd) ** 2)
    return np.asarray(density / density.sum())


def _peak(density: np.ndarray) -> float:
    return float(np.exp(GRID[np.argmax(density)]))


def test_votes_of_many_cars_make_a_narrow_density_at_their_scale() -> None:
    lengths = 30 * np.exp(np.random.default_rng(0).normal(0, 0.1, 40))
    density = vehicle_density(lengths, np.full(40, 0.9), 4.5, (0.0, 0.0), _VOTES)
    assert _peak(density) == pytest.approx(0.15, rel=0.04)
    low, high = credible_interval(density)
    assert low < 0.15 < high < 1.12 * low


def test_the_binned_votes_are_the_product_of_the_boxes_likelihoods() -> None:
    lengths, scores = np.array([20.0, 22.0, 60.0]), np.array([0.9, 0.3, 0.6])
    shares = _VOTES.car_shares(scores)
    distance = np.log(4.5 / lengths)[:, None] - GRID
    normal = np.exp(-0.5 * (distance / 0.12) ** 2) / (0.12 * np.sqrt(2 * np.pi))
    likelihood = np.prod((1 - shares[:, None]) + shares[:, None] * normal / 0.3, axis=0)
    expected = likelihood / likelihood.sum()
    np.testing.assert_allclose(
        vehicle_density(lengths, scores, 4.5, (0.0, 0.0), _VOTES), expected, atol=0.03 * expected.max()
    )


def test_no_boxes_say_nothing() -> None:
    np.testing.assert_array_equal(vehicle_density([], [], 4.5, (0.07, 0.07), _VOTES), flat())


def test_one_liar_cannot_veto_two_that_agree() -> None:
    truth, lie = _normal(0.2, 0.05), _normal(0.05, 0.05)
    fused = product(with_outlier_floor(truth, 0.02), with_outlier_floor(truth, 0.02), with_outlier_floor(lie, 0.02))
    assert _peak(fused) == pytest.approx(0.2, rel=0.01)
    assert mass_within(fused, 0.2, 0.2) > 0.95


def test_two_humps_of_like_weight_give_an_interval_that_holds_both() -> None:
    low, high = credible_interval((_normal(0.1, 0.03) + _normal(0.3, 0.03)) / 2)
    assert low < 0.1
    assert high > 0.3


@given(st.floats(0.02, 1.0), st.floats(0.02, 0.3), st.floats(0.0, 0.3))
def test_widening_adds_up_variances(gsd: float, log_sd: float, more: float) -> None:
    wide = blurred(_normal(gsd, log_sd), more)
    mean = float(np.sum(wide * GRID))
    assert wide.sum() == pytest.approx(1)
    assert mean == pytest.approx(np.log(gsd), abs=0.05)
    assert np.sqrt(np.sum(wide * (GRID - mean) ** 2)) == pytest.approx(np.hypot(log_sd, more), abs=0.02)


def test_the_mass_within_a_tolerance_is_that_of_the_true_scales_it_allows() -> None:
    density = np.zeros(len(GRID))
    density[np.argmin(np.abs(GRID - np.log(0.1)))] = 1.0
    assert mass_within(density, 0.119, 0.2) == pytest.approx(1, abs=LOG_STEP)
    assert mass_within(density, 0.122, 0.2) == pytest.approx(0, abs=1e-9)
    assert mass_within(density, 0.081, 0.2) == pytest.approx(1, abs=1e-9)
    assert mass_within(density, 0.079, 0.2) == pytest.approx(0, abs=1e-9)


def test_an_interval_holds_the_scale_that_is_given_out() -> None:
    fused = fuse(0.2, _normal(0.1, 0.05))
    assert fused.interval.low < 0.1 < fused.interval.high == 0.2
    assert fused.p_within_20 < 0.01


def test_what_the_reference_length_is_off_by_widens_the_interval_of_any_number_of_cars() -> None:
    lengths = 30 * np.exp(np.random.default_rng(0).normal(0, 0.1, 400))
    known, unknown = (
        fuse(0.15, vehicle_density(lengths, np.full(400, 0.9), 4.5, (sd, sd), _VOTES)) for sd in (0.0, 0.1)
    )
    assert known.interval.high / known.interval.low < 1.1
    assert unknown.interval.high / unknown.interval.low == pytest.approx(np.exp(2 * 1.96 * 0.1), rel=0.05)


@given(st.floats(0.0, 1.0), st.floats(0.2, 3.0))
def test_certainty_moves_chances_away_from_the_limit_of_use_and_none_across_it(chance: float, sharpness: float) -> None:
    calibrated = float(recalibrated(chance, sharpness))
    assert 0 <= calibrated <= 1
    assert (calibrated >= USABLE_CHANCE - 1e-9) or chance < USABLE_CHANCE
    assert (calibrated <= USABLE_CHANCE + 1e-9) or chance > USABLE_CHANCE


def test_a_certainty_of_one_changes_no_chance() -> None:
    assert recalibrated([0.1, 0.9, 0.99], 1.0) == pytest.approx([0.1, 0.9, 0.99])
    assert fuse(0.2, _normal(0.2, 0.15), sharpness=2.0).p_within_20 < fuse(0.2, _normal(0.2, 0.15)).p_within_20 < 0.9


def test_a_fleet_that_may_be_smaller_moves_the_finer_end_only() -> None:
    lengths, scores = np.full(60, 30.0), np.full(60, 0.9)
    even, wide = (vehicle_density(lengths, scores, 4.5, sds, _VOTES) for sds in ((0.08, 0.08), (0.12, 0.08)))
    (low, high), (wide_low, wide_high) = (credible_interval(density) for density in (even, wide))
    assert wide_low < 0.95 * low
    assert wide_high == pytest.approx(high, rel=0.02)
