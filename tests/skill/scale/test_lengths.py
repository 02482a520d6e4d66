"""Lengths of vehicles: outlier filter, kernel density, modal length and its error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import gaussian_kde

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.lengths import (
    guard_length,
    inlier_mask,
    kde_density,
    kde_mode,
    modal_density,
    modal_length,
    statistical_log_sds,
)

_LENGTHS = st.lists(st.floats(5, 80), min_size=2, max_size=60)


def _fleet(seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(30, 3, n)


def test_the_outlier_filter_is_one_sided() -> None:
    assert inlier_mask([10, 10, 10, 15, 15.01]).tolist() == [True, True, True, True, False]


def test_without_a_factor_no_length_is_an_outlier() -> None:
    assert inlier_mask([1, 2, 300], None).all()


def test_the_outlier_filter_accepts_no_lengths() -> None:
    assert inlier_mask([]).tolist() == []


@given(_LENGTHS, st.booleans())
@settings(max_examples=40)
def test_density_equals_scipys(lengths: list[float], weighted: bool) -> None:
    assume(np.std(lengths) >= 1e-3)
    weights = np.linspace(0.2, 1.0, len(lengths)) if weighted else None
    at = np.linspace(min(lengths), max(lengths), 7)
    np.testing.assert_allclose(
        kde_density(at, lengths, weights), gaussian_kde(lengths, weights=weights)(at), rtol=1e-9
    )


@given(st.integers(0, 300), st.integers(5, 200))
@settings(max_examples=15)
@example(12, 114)  # two peaks of nearly one height
def test_the_mode_is_scipys_maximum_to_a_thousandth_of_a_pixel(seed: int, n: int) -> None:
    lengths = _fleet(seed, n)
    oracle = gaussian_kde(lengths)
    grid = np.linspace(lengths.min(), lengths.max(), 1500)
    density = oracle(grid)
    top = grid[np.argmax(density)]
    step = grid[1] - grid[0]
    best = minimize_scalar(
        lambda x: -oracle(x)[0],
        bounds=(top - step, top + step),
        method="bounded",
        options={"xatol": 1e-7},
    )
    mode = kde_mode(lengths)
    assert abs(mode - best.x) < 1e-3 or oracle(mode)[0] >= density.max() * (1 - 1e-9)


@given(_LENGTHS, st.floats(0.2, 5))
def test_scaling_the_lengths_scales_the_mode(lengths: list[float], factor: float) -> None:
    assume(np.std(lengths) >= 1e-2)
    values = np.array(lengths)
    density = kde_density(np.array([kde_mode(values * factor) / factor, kde_mode(values)]), values)
    # equal heights: the same maximum, or two that tie
    assert density[0] == pytest.approx(density[1], rel=1e-6)


@pytest.mark.parametrize(("lengths", "mode"), [([17.0] * 9, 17.0), ([10.0, 10.0 + 1e-12], 10.0)])
def test_equal_lengths_have_a_mode(lengths: list[float], mode: float) -> None:
    assert kde_mode(lengths) == pytest.approx(mode)


def test_a_single_length_is_its_mode() -> None:
    assert kde_mode([23.5]) == 23.5


def test_the_density_of_equal_lengths_is_zero() -> None:
    assert (kde_density([1.0, 2.0], [5.0, 5.0]) == 0).all()


@pytest.mark.parametrize(
    ("lengths", "weights"), [([], None), ([1.0, 2.0], [0.0, 0.0]), ([1.0, 2.0], [1.0])]
)
def test_a_mode_without_weight_is_refused(
    lengths: list[float], weights: list[float] | None
) -> None:
    with pytest.raises(InvalidParameterError):
        kde_mode(lengths, weights=weights)


_POINTS = np.linspace(20, 40, 20001)


def _weighted_fleet() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths and scores of sixty cars, and SciPy's density of them at the points."""
    rng = np.random.default_rng(3)
    lengths = rng.normal(30, 3, 60)
    scores = rng.uniform(0.5, 0.9, 60)
    weights = scores**2 * lengths
    factor = gaussian_kde(lengths, weights=weights).factor
    density = gaussian_kde(lengths, weights=weights, bw_method=2 * factor)
    return lengths, scores, density(_POINTS)


def test_the_weighted_density_is_scipys_with_twice_the_bandwidth() -> None:
    lengths, scores, expected = _weighted_fleet()
    density = modal_density(_POINTS, lengths, scores=scores, aggregation="weighted_kde")
    np.testing.assert_allclose(density, expected, rtol=1e-9)


def test_the_weighted_mode_is_that_of_scipys_density() -> None:
    lengths, scores, expected = _weighted_fleet()
    mode, _ = modal_length(lengths, scores, "weighted_kde")
    assert mode == pytest.approx(_POINTS[np.argmax(expected)], abs=1e-3)


def test_the_weighted_mode_has_the_interval_of_its_own_density() -> None:
    """Half-hidden cars of low score widen the plain interval, and hardly the weighted one."""
    rng = np.random.default_rng(5)
    lengths = np.concatenate([rng.normal(30, 1.0, 40), rng.normal(20, 2.0, 38)])
    scores = np.concatenate([np.full(40, 0.9), np.full(38, 0.2)])
    mode, _ = modal_length(lengths, scores, "weighted_kde")
    weighted, _ = statistical_log_sds(lengths, scores, mode, "weighted_kde")
    plain, _ = statistical_log_sds(lengths, scores, mode, "kde")
    assert weighted < plain


def test_fewer_than_five_lengths_fall_back_to_the_median() -> None:
    assert modal_length([10, 11, 12, 30], np.ones(4)) == (11.5, "median")
    assert modal_length([10, 11, 12, 13, 30], np.ones(5))[1] == "kde"


def test_the_mean_is_used_for_any_number_of_lengths() -> None:
    assert modal_length([10, 11, 12, 30], np.ones(4), "mean") == (15.75, "mean")


def test_the_median_is_used_for_any_number_of_lengths() -> None:
    assert modal_length([10, 11, 12, 13, 30], np.ones(5), "median") == (12.0, "median")


def test_few_vehicles_never_give_a_narrow_interval() -> None:
    first, second, fifth, last = [
        statistical_log_sds([30.0] * n, [0.9] * n, 30.0, "kde")[1] for n in (1, 2, 5, 50)
    ]
    assert first > 0.17
    assert first > second > fifth > last > 0.0


def test_the_guard_follows_the_reference_length() -> None:
    assert guard_length(5.045) == pytest.approx(16.82, abs=0.01)  # the paper's "about 17 px"
    assert guard_length(4.5) == pytest.approx(15.0)


def test_the_guard_is_at_least_the_models_limit() -> None:
    assert guard_length(4.5, min_length_px=18.0) == 18.0
