from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.scale.density import GRID, LOG_STEP, blurred, credible_interval, flat, lognormal, mass_within, product
from vehanchor.scale.votes import Votes, vehicle_likelihood

_VOTES = Votes(-2.0, 5.0)


def _peak(density: np.ndarray) -> float:
    return float(np.exp(GRID[np.argmax(density)]))


def test_votes_of_many_cars_make_a_narrow_density_at_their_scale() -> None:
    lengths = 30 * np.exp(np.random.default_rng(0).normal(0, 0.1, 40))
    density = vehicle_likelihood(lengths, np.full(40, 0.9), 4.5, _VOTES)
    assert _peak(density) == pytest.approx(0.15, rel=0.04)
    low, high = credible_interval(density)
    assert low < 0.15 < high < 1.12 * low


def test_the_binned_votes_are_the_product_of_the_boxes_likelihoods() -> None:
    lengths, scores = np.array([20.0, 22.0, 60.0]), np.array([0.9, 0.3, 0.6])
    odds = np.exp(_VOTES.log_odds(scores))
    distance = np.log(4.5 / lengths)[:, None] - GRID
    normal = np.exp(-0.5 * (distance / 0.12) ** 2) / (0.12 * np.sqrt(2 * np.pi))
    likelihood = np.prod(1 + odds[:, None] * normal, axis=0)
    expected = likelihood / likelihood.sum()
    np.testing.assert_allclose(vehicle_likelihood(lengths, scores, 4.5, _VOTES), expected, atol=0.03 * expected.max())


def test_no_boxes_say_nothing() -> None:
    np.testing.assert_array_equal(vehicle_likelihood([], [], 4.5, _VOTES), flat())


def test_a_box_of_a_low_score_says_less_than_one_of_a_high_score() -> None:
    low, high = (vehicle_likelihood([30.0], [score], 4.5, Votes(-13.76, 17.4)) for score in (0.6, 0.95))
    assert low.max() < high.max()
    assert low.max() < 1.5 * low.min()


def test_two_humps_of_like_weight_give_an_interval_that_holds_both() -> None:
    low, high = credible_interval((lognormal(0.1, 0.03) + lognormal(0.3, 0.03)) / 2)
    assert low < 0.1
    assert high > 0.3


@given(st.floats(0.02, 1.0), st.floats(0.02, 0.3), st.floats(0.0, 0.3), st.floats(-0.2, 0.2))
def test_an_error_adds_its_mean_and_its_variance(gsd: float, log_sd: float, more: float, mean: float) -> None:
    wide = blurred(lognormal(gsd, log_sd), (1.0, mean, more))
    centre = float(np.sum(wide * GRID))
    assert wide.sum() == pytest.approx(1)
    assert centre == pytest.approx(np.log(gsd) + mean, abs=0.05)
    assert np.sqrt(np.sum(wide * (GRID - centre) ** 2)) == pytest.approx(np.hypot(log_sd, more), abs=0.03)


def test_a_mixture_of_errors_widens_the_finer_end_only() -> None:
    density = lognormal(0.15, 0.02)
    even, mixed = blurred(density, (1.0, 0.0, 0.06)), blurred(density, (0.7, 0.0, 0.06), (0.3, -0.1, 0.06))
    (low, high), (mixed_low, mixed_high) = credible_interval(even), credible_interval(mixed)
    assert mixed_low < 0.95 * low
    assert mixed_high == pytest.approx(high, rel=0.02)


def test_the_mass_within_a_tolerance_is_that_of_the_true_scales_it_allows() -> None:
    density = np.zeros(len(GRID))
    density[np.argmin(np.abs(GRID - np.log(0.1)))] = 1.0
    assert mass_within(density, 0.119, 0.2) == pytest.approx(1, abs=LOG_STEP)
    assert mass_within(density, 0.122, 0.2) == pytest.approx(0, abs=1e-9)
    assert mass_within(density, 0.081, 0.2) == pytest.approx(1, abs=1e-9)
    assert mass_within(density, 0.079, 0.2) == pytest.approx(0, abs=1e-9)


def test_a_product_of_equal_densities_is_narrower_by_the_root_of_two() -> None:
    low, high = credible_interval(product(lognormal(0.1, 0.1), lognormal(0.1, 0.1)))
    assert np.log(high / low) == pytest.approx(2 * 1.96 * 0.1 / np.sqrt(2), rel=0.03)
