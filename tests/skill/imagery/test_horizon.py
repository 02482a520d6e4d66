"""The horizon is a straight border between a smooth bright sky and the ground."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import vehanchor
from research.scenes import Layout, render_scene
from vehanchor.imagery.horizon import find_horizon
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.records.advice import advice_for

SIDE_PX = 512
HORIZON_PX = 130
SKY_RGB = (200, 215, 235)
WATER_RGB = (30, 55, 60)


@cache
def _ground(layout: Layout = "parking") -> NDArray[np.uint8]:
    return render_scene(0.1, width_px=SIDE_PX, height_px=SIDE_PX, seed=4, layout=layout).image


def _below(rgb: tuple[int, int, int], *, haze: float) -> NDArray[np.uint8]:
    """Paint a smooth band over a scene, and haze below it, with a tilted border."""
    row, column = np.mgrid[:SIDE_PX, :SIDE_PX]
    below_px = row - HORIZON_PX - 0.05 * (column - SIDE_PX / 2)
    share = np.where(below_px < 0, 1.0, haze * np.exp(-np.maximum(below_px, 0) / 80))
    band = np.array(rgb) + np.random.default_rng(1).normal(0, 2, (SIDE_PX, SIDE_PX, 1))
    mixed = share[:, :, None] * band + (1 - share[:, :, None]) * _ground()
    return np.asarray(np.clip(mixed, 0, 255), np.uint8)


def _horizon(picture: NDArray[np.uint8]) -> int | None:
    with open_raster(picture) as raster:
        return find_horizon(raster)


def test_a_sky_has_a_horizon_below_it() -> None:
    assert _horizon(_below(SKY_RGB, haze=0.8)) == pytest.approx(HORIZON_PX, abs=10)


@pytest.mark.parametrize("layout", ["parking", "countryside", "urban"])
def test_a_scene_from_above_has_no_horizon(layout: Layout) -> None:
    assert _horizon(_ground(layout)) is None


def test_calm_water_has_no_horizon() -> None:
    assert _horizon(_below(WATER_RGB, haze=0.0)) is None


def test_a_margin_has_no_horizon() -> None:
    picture = cv2.copyMakeBorder(_ground(), 90, 0, 0, 0, cv2.BORDER_CONSTANT, value=(255,) * 3)
    assert _horizon(np.asarray(picture, np.uint8)) is None


def test_an_image_with_the_horizon_has_no_scale() -> None:
    estimate = vehanchor.estimate_gsd(_below(SKY_RGB, haze=0.8))
    advice = advice_for(estimate)
    assert (estimate.status, estimate.reason) == ("no_scale", "oblique")
    assert advice is not None
    assert advice.remedies == ("nadir",)
