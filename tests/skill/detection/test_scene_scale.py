"""What the ground's density says of a candidate's size, and what the search makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.detection.scene_scale import (
    FACTORS,
    MOST_TILES,
    TILE_PX,
    SceneCalibration,
    SceneScalePrior,
    scene_density,
    tile_windows,
)
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, credible_interval

_CALIBRATION = SceneCalibration(np.log(0.01), 0.08, floor=0.02)


def _ground(gsd_m_per_px: float, log_sd: float, finer: float = 0.0) -> SceneScalePrior:
    bins = np.arange(60) * _CALIBRATION.log_step + _CALIBRATION.first_log_gsd
    level = (1, -0.5 * ((bins - np.log(gsd_m_per_px)) / log_sd) ** 2)
    return SceneScalePrior(scene_density([level], replace(_CALIBRATION, finer=finer)), 9)


@pytest.mark.parametrize(("gsd", "wider"), [(0.06, 1.55), (0.6, 1.0)])
def test_a_sharp_place_may_be_finer_than_it_looks(gsd: float, wider: float) -> None:
    """The interval opens downwards only, and only where few places trained the network."""
    plain = credible_interval(_ground(gsd, 0.15).density)
    open_prior = _ground(gsd, 0.15, finer=0.2)
    low, high = credible_interval(open_prior.density)
    assert open_prior.density.sum() == pytest.approx(1)
    assert plain.low / low == pytest.approx(wider, rel=0.15)
    assert high == pytest.approx(plain.high, rel=0.03)


def test_a_length_that_fits_the_scene_has_the_better_odds() -> None:
    fits, long, longer = _ground(0.1, 0.15).size_odds(CAR_LENGTH_M / np.array([0.1, 0.07, 0.01]))
    assert fits > 1 > long > longer == -2
    # of a grid
    assert _ground(0.1, 0.15).scaled(2.0).size_odds([CAR_LENGTH_M / 0.2]) == pytest.approx(
        fits, rel=1e-3
    )


@pytest.mark.parametrize(
    ("width", "height"), [(160, 160), (256, 256), (1000, 700), (4096, 4096), (9000, 200)]
)
def test_tiles_lie_inside_the_image_and_are_not_too_many(width: int, height: int) -> None:
    levels = tile_windows(width, height)
    assert [factor for factor, _ in levels] == [
        f for f in FACTORS if min(width, height) >= TILE_PX * f
    ]
    for factor, windows in levels:
        assert 1 <= len(windows) <= MOST_TILES
        assert all(
            window.x_px >= 0 and window.x_px + window.width_px <= width // factor
            for window in windows
        )
        assert all(
            window.y_px >= 0 and window.y_px + window.height_px <= height // factor
            for window in windows
        )


def _log_probs(gsd_m_per_px: float) -> NDArray[np.float64]:
    """Log-probabilities of a tile that says a scale."""
    centres = np.arange(60) * _CALIBRATION.log_step + _CALIBRATION.first_log_gsd
    peak = np.exp(-0.5 * ((centres - np.log(gsd_m_per_px)) / 0.12) ** 2)
    return np.asarray(np.log(0.99 * peak / peak.sum() + 0.01 / 60))


def _density(*levels: tuple[int, list[float]], **changes: float) -> NDArray[np.float64]:
    """The density of an image from the scales that the tiles of each level say."""
    seen = [(factor, np.mean([_log_probs(gsd) for gsd in said], axis=0)) for factor, said in levels]
    return scene_density(seen, replace(_CALIBRATION, **{"doubt": 0.01, "floor": 0.01, **changes}))


def test_levels_that_say_the_same_of_one_image_agree_in_its_density() -> None:
    density = _density((1, [0.1]), (2, [0.2]), (4, [0.4]))
    assert density.sum() == pytest.approx(1.0)
    assert np.exp(GRID[density.argmax()]) == pytest.approx(0.1, rel=0.03)
    interval = credible_interval(density)
    assert 0.06 < interval.low < 0.1 < interval.high < 0.16


def test_tiles_that_disagree_widen_the_density() -> None:
    agreed, torn = (credible_interval(_density((1, said))) for said in ([0.1, 0.1], [0.07, 0.14]))
    assert np.log(torn.high / torn.low) > 1.2 * np.log(agreed.high / agreed.low)


def test_what_is_finer_than_all_training_is_not_denied() -> None:
    assert credible_interval(_density((1, [0.01]))).low < 0.005
    known = _density((1, [0.01]), (8, [8 * 0.01]))
    assert np.exp(GRID[known.argmax()]) == pytest.approx(0.01, rel=0.1)
