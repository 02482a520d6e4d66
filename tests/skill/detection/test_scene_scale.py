"""The scene-scale prior: its density, its tiles, and the odds of a candidate's size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.detection.scene_scale import (
    FACTORS,
    MAX_TILES,
    TILE_PX,
    SceneCalibration,
    SceneScalePrior,
    scene_density,
    tile_windows,
)
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, credible_interval, quantile

_CALIBRATION = SceneCalibration(np.log(0.01), 0.08, floor=0.02)


def _prior(gsd_m_per_px: float, log_sd: float, finer: float = 0.0) -> SceneScalePrior:
    bins = np.arange(60) * _CALIBRATION.log_step + _CALIBRATION.first_log_gsd
    log_probs = -0.5 * ((bins - np.log(gsd_m_per_px)) / log_sd) ** 2
    calibration = replace(_CALIBRATION, finer=finer)
    return SceneScalePrior(scene_density([(1, log_probs)], calibration), 9)


@pytest.mark.parametrize(("gsd", "wider"), [(0.06, 1.55), (0.6, 1.0)])
def test_a_sharp_place_may_be_finer_than_it_looks(gsd: float, wider: float) -> None:
    """The interval opens downwards only, and only where few places trained the network."""
    plain = credible_interval(_prior(gsd, 0.15).density)
    open_prior = _prior(gsd, 0.15, finer=0.2)
    low, high = credible_interval(open_prior.density)
    assert open_prior.density.sum() == pytest.approx(1)
    assert plain.low / low == pytest.approx(wider, rel=0.15)
    assert high == pytest.approx(plain.high, rel=0.03)


@pytest.mark.parametrize(("log_sd", "lower"), [(0.2, 1.0), (0.5, 1.4)])
def test_only_a_wide_density_opens_far_to_finer_scales(log_sd: float, lower: float) -> None:
    """Fields and lawns resemble little in training, and look coarser than they are."""
    sharp = _prior(0.06, log_sd).density
    coarse = _prior(0.3, log_sd).density
    opened = quantile(coarse, 0.16) / 0.3 / (quantile(sharp, 0.16) / 0.06)
    assert opened == pytest.approx(lower, rel=0.1)


def test_a_density_opens_smoothly_with_its_width() -> None:
    log_sds = np.linspace(0.2, 0.7, 26)
    lows = np.log([quantile(_prior(0.06, log_sd).density, 0.16) for log_sd in log_sds])
    steps = np.diff(lows)
    assert (steps < 0).all()
    assert np.abs(steps).max() < 0.12


@pytest.mark.parametrize(("log_sd", "flat_share"), [(0.3, 0.02), (0.6, 0.4)])
def test_only_a_density_wider_than_that_of_fields_falls_to_flat(
    log_sd: float, flat_share: float
) -> None:
    """A picture of water resembles nothing in training, and its density is often wrong."""
    far = np.abs(GRID - np.log(0.004)) < 0.1
    flat_mass = _prior(0.15, log_sd).density[far].mean() * len(GRID)
    assert flat_mass == pytest.approx(flat_share, rel=0.1)


def test_no_density_is_more_certain_than_places_differ() -> None:
    """All tiles of a place can agree, and have the same error."""
    density = _prior(0.3, 0.001).density
    log_high = np.log(quantile(density, 0.84))
    log_low = np.log(quantile(density, 0.16))
    assert (log_high - log_low) / 2 > 0.1


def test_a_length_that_fits_the_scene_has_the_better_odds() -> None:
    gsds = np.array([0.1, 0.07, 0.01])
    fits, long, longer = _prior(0.1, 0.15).size_odds(CAR_LENGTH_M / gsds)
    assert fits > 1 > long > longer == -2


def test_a_moved_prior_has_the_same_odds_for_moved_lengths() -> None:
    prior = _prior(0.1, 0.15)
    odds = prior.size_odds([CAR_LENGTH_M / 0.1])
    # They differ by the steps of the grid.
    assert prior.scaled(2.0).size_odds([CAR_LENGTH_M / 0.2]) == pytest.approx(odds, rel=1e-3)


_SIZES = [(160, 160), (256, 256), (1000, 700), (4096, 4096), (9000, 200)]


@pytest.mark.parametrize(("width", "height"), _SIZES)
def test_every_level_that_holds_a_tile_has_tiles(width: int, height: int) -> None:
    levels = tile_windows(width, height)
    expected = [factor for factor in FACTORS if min(width, height) >= TILE_PX * factor]
    assert [factor for factor, _ in levels] == expected
    for _, windows in levels:
        assert 1 <= len(windows) <= MAX_TILES


@pytest.mark.parametrize(("width", "height"), _SIZES)
def test_tiles_lie_inside_the_image(width: int, height: int) -> None:
    for factor, windows in tile_windows(width, height):
        for window in windows:
            assert window.x_px >= 0
            assert window.y_px >= 0
            assert window.x_px + window.width_px <= width // factor
            assert window.y_px + window.height_px <= height // factor


def _log_probs(gsd_m_per_px: float) -> NDArray[np.float64]:
    """Log-probabilities of a tile of one scale."""
    centres = np.arange(60) * _CALIBRATION.log_step + _CALIBRATION.first_log_gsd
    peak = np.exp(-0.5 * ((centres - np.log(gsd_m_per_px)) / 0.12) ** 2)
    return np.asarray(np.log(0.99 * peak / peak.sum() + 0.01 / 60))


def _density(*levels: tuple[int, list[float]], **changes: float) -> NDArray[np.float64]:
    """The density of an image from the scales of the tiles of each level."""
    predictions = []
    for factor, gsds in levels:
        mean = np.mean([_log_probs(gsd) for gsd in gsds], axis=0)
        predictions.append((factor, mean))
    calibration = replace(_CALIBRATION, **{"doubt": 0.01, "floor": 0.01, **changes})
    return scene_density(predictions, calibration)


def test_levels_that_agree_give_a_narrow_density() -> None:
    density = _density((1, [0.1]), (2, [0.2]), (4, [0.4]))
    assert density.sum() == pytest.approx(1.0)
    assert np.exp(GRID[density.argmax()]) == pytest.approx(0.1, rel=0.03)
    interval = credible_interval(density)
    assert 0.06 < interval.low < 0.1 < interval.high < 0.16


def test_tiles_that_disagree_widen_the_density() -> None:
    agreed = credible_interval(_density((1, [0.1, 0.1])))
    torn = credible_interval(_density((1, [0.07, 0.14])))
    assert np.log(torn.high / torn.low) > 1.2 * np.log(agreed.high / agreed.low)


def test_a_scale_finer_than_all_training_is_possible() -> None:
    assert credible_interval(_density((1, [0.01]))).low < 0.005
    known = _density((1, [0.01]), (8, [8 * 0.01]))
    assert np.exp(GRID[known.argmax()]) == pytest.approx(0.01, rel=0.1)
