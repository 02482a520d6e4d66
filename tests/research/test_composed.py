"""Photographs that are not one view: the doubts find most of them."""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from research.scenes.composed import pasted, stretched, with_inset
from tests.flight.ground import ground
from vehanchor.imagery.axis_detail import measure_detail_difference
from vehanchor.imagery.seams import find_seam
from vehanchor.imagery.sources.arrays import ArrayRaster

GROUNDS = [ground(400, seed=seed) for seed in range(4)]


def _raster(image: NDArray[np.uint8]) -> ArrayRaster:
    return ArrayRaster(np.ascontiguousarray(image), "array", None)


def test_most_insets_are_found() -> None:
    rng = random.Random(13)
    found = 0
    for k in range(10):
        composed = with_inset(GROUNDS[k % 4], GROUNDS[(k + 1) % 4], rng)
        found += find_seam(_raster(composed.image)) is not None
    assert found >= 6


def test_most_stretched_images_have_less_detail_in_the_longer_direction() -> None:
    rng = random.Random(9)
    agreeing = 0
    for k in range(10):
        changed = stretched(GROUNDS[k % 4], rng)
        difference = measure_detail_difference(_raster(changed.image))
        assert difference is not None
        agreeing += (difference < 0) == (changed.across > changed.down)
    assert agreeing >= 8


def test_a_car_is_pasted_nine_times_beside_the_border_never() -> None:
    rng = random.Random(9)
    image = pasted(GROUNDS[0], np.array([200.0, 200.0, 40.0, 18.0, 0.3]), rng)
    assert image is not None
    assert min(image.shape[:2]) > 3 * 40
    assert pasted(GROUNDS[0], np.array([10.0, 200.0, 40.0, 18.0, 0.3]), rng) is None
