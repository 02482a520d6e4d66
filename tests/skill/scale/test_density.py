"""Densities over the log scale: votes of boxes, errors that widen them, and masses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.scale.density import (
    GRID,
    LOG_STEP,
    Votes,
    blurred,
    lognormal,
    mass_within,
    vehicle_likelihood,
)

_VOTES = Votes(-2.0, 5.0)


def test_the_binned_votes_are_the_product_of_the_boxes_likelihoods() -> None:
    lengths = np.array([20.0, 22.0, 60.0])
    scores = np.array([0.9, 0.3, 0.6])
    odds = np.exp(_VOTES.log_odds(scores))
    distance = np.log(4.5 / lengths)[:, None] - GRID
    normal = np.exp(-0.5 * (distance / 0.12) ** 2) / (0.12 * np.sqrt(2 * np.pi))
    likelihood = np.prod(1 + odds[:, None] * normal, axis=0)
    expected = likelihood / likelihood.sum()
    np.testing.assert_allclose(
        vehicle_likelihood(lengths, scores, lengths_m=4.5, votes=_VOTES),
        expected,
        atol=0.03 * expected.max(),
    )


def test_a_box_of_a_low_score_says_less_than_one_of_a_high_score() -> None:
    low, high = (
        vehicle_likelihood([30.0], [score], lengths_m=4.5, votes=Votes(-13.76, 17.4))
        for score in (0.6, 0.95)
    )
    assert low.max() < high.max()
    assert low.max() < 1.5 * low.min()


@given(st.floats(0.02, 1.0), st.floats(0.02, 0.3), st.floats(0.0, 0.3), st.floats(-0.2, 0.2))
def test_an_error_adds_its_mean_and_its_variance(
    gsd: float, log_sd: float, more: float, mean: float
) -> None:
    wide = blurred(lognormal(gsd, log_sd), more, mean)
    centre = float(np.sum(wide * GRID))
    assert wide.sum() == pytest.approx(1)
    assert centre == pytest.approx(np.log(gsd) + mean, abs=0.05)
    assert np.sqrt(np.sum(wide * (GRID - centre) ** 2)) == pytest.approx(
        np.hypot(log_sd, more), abs=0.03
    )


def test_the_mass_within_a_tolerance_is_that_of_the_true_scales_it_allows() -> None:
    density = np.zeros(len(GRID))
    density[np.argmin(np.abs(GRID - np.log(0.1)))] = 1.0
    assert mass_within(density, 0.119) == pytest.approx(1, abs=LOG_STEP)
    assert mass_within(density, 0.122) == pytest.approx(0, abs=1e-9)
    assert mass_within(density, 0.081) == pytest.approx(1, abs=1e-9)
    assert mass_within(density, 0.079) == pytest.approx(0, abs=1e-9)
