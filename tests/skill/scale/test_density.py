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
        vehicle_likelihood(lengths, scores, lengths_m=4.5, votes=_VOTES, log_sds=0.12),
        expected,
        atol=0.03 * expected.max(),
    )


def test_a_box_of_a_low_score_says_less_than_one_of_a_high_score() -> None:
    votes = Votes(-13.76, 17.4)
    low = vehicle_likelihood([30.0], [0.6], lengths_m=4.5, votes=votes, log_sds=0.12)
    high = vehicle_likelihood([30.0], [0.95], lengths_m=4.5, votes=votes, log_sds=0.12)
    assert low.max() < high.max()
    assert low.max() < 1.5 * low.min()


@given(st.floats(0.02, 1.0), st.floats(0.02, 0.3), st.floats(0.0, 0.3), st.floats(-0.2, 0.2))
def test_a_blurred_density_has_both_means_with_both_variances(
    gsd: float, log_sd: float, error_log_sd: float, error_mean: float
) -> None:
    wide = blurred(lognormal(gsd, log_sd), error_log_sd, error_mean)
    centre = float(np.sum(wide * GRID))
    spread = np.sqrt(np.sum(wide * (GRID - centre) ** 2))
    assert wide.sum() == pytest.approx(1)
    assert centre == pytest.approx(np.log(gsd) + error_mean, abs=0.05)
    assert spread == pytest.approx(np.hypot(log_sd, error_log_sd), abs=0.03)


@pytest.mark.parametrize(
    ("estimated", "mass", "tolerance"),
    [(0.119, 1, LOG_STEP), (0.122, 0, 1e-9), (0.081, 1, 1e-9), (0.079, 0, 1e-9)],
)
def test_an_estimate_is_right_within_a_fifth_of_the_true_scale(
    estimated: float, mass: float, tolerance: float
) -> None:
    density = np.zeros(len(GRID))
    density[np.argmin(np.abs(GRID - np.log(0.1)))] = 1.0
    assert mass_within(density, estimated) == pytest.approx(mass, abs=tolerance)
