"""The order in which the tiles of a large image are visited."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehanchor.detection.scheduler import TilePlace, TileScheduler, level_shares, spread_order
from vehanchor.imagery.tiles import tile_grid
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from numpy.typing import NDArray

_RANGES = {1: (9.0, 64.0), 2: (25.6, 64.0), 4: (25.6, 64.0), 8: (25.6, np.inf)}


def _places(side: int, factors: tuple[int, ...] = (1, 2)) -> list[TilePlace]:
    return [
        TilePlace(factor, tile)
        for factor in factors
        for tile in tile_grid(side // factor, side // factor, tile_px=64, stride_px=48)
    ]


def _around(gsd: float) -> NDArray[np.float64]:
    density = np.exp(-0.5 * ((GRID - np.log(gsd)) / 0.2) ** 2)
    return np.asarray(density / density.sum())


@settings(max_examples=25)
@given(st.integers(16, 500), st.integers(1, 9), st.randoms(use_true_random=False))
def test_every_tile_is_taken_once_whatever_the_others_showed(side: int, at_once: int, random: object) -> None:
    places = _places(side, (1, 2, 4))
    rng = np.random.default_rng(random.randrange(1000))  # type: ignore[attr-defined]
    order = TileScheduler(
        places, rng.random(len(places)), level_shares({1: (9, 64), 2: (25, 64), 4: (25, np.inf)}, None)
    )
    taken: list[int] = []
    while batch := order.next_tiles(at_once):
        assert len(batch) <= at_once
        taken += batch
        for tile in batch:
            order.report(tile, int(rng.integers(0, 9)))
    assert sorted(taken) == list(range(len(places)))


def test_what_promises_cars_comes_first_and_every_fourth_tile_comes_from_anywhere() -> None:
    places = _places(1600, (1,))
    tile_prior = np.array([0.9 if place.window.x_px > 1000 else 0.1 for place in places])
    first = TileScheduler(places, tile_prior, {1: 1.0}).next_tiles(40)
    right = np.array([places[k].window.x_px > 1000 for k in first])
    assert right.mean() >= 0.75
    assert {k for k, is_right in enumerate(right) if not is_right} <= set(range(3, 40, 4))
    assert (~right).any()


def test_cars_that_were_found_draw_the_search_to_their_neighbours() -> None:
    places = _places(1600, (1,))
    order = TileScheduler(places, np.full(len(places), 0.5), {1: 1.0})
    for tile in order.next_tiles(8):
        order.report(tile, 30 if places[tile].window.y_px < 800 else 0)
    following = [places[k].window.y_px for k in order.next_tiles(30)]
    assert np.mean(np.array(following) < 800) > 0.7


def test_the_first_tiles_of_the_spread_order_lie_in_every_part_of_the_image() -> None:
    places = _places(1600, (1,))
    order = spread_order(places)
    assert sorted(order) == list(range(len(places)))
    for count in (9, 30, 100):
        at = np.array([(places[int(k)].window.x_px, places[int(k)].window.y_px)
                       for k in order[:count]])  # fmt: skip
        quarters = np.bincount((at[:, 0] > 768) * 2 + (at[:, 1] > 768), minlength=4)
        assert quarters.min() >= 0.6 * count / 4


@pytest.mark.parametrize(("gsd", "factor"), [(0.2, 1), (0.06, 2), (0.03, 4), (0.012, 8)])
def test_most_tiles_belong_to_the_resolution_that_cars_fit(gsd: float, factor: int) -> None:
    shares = level_shares(_RANGES, _around(gsd))
    assert sum(shares.values()) == pytest.approx(1)
    assert max(shares, key=lambda each: shares[each]) == factor
    assert min(shares.values()) >= 0.05
    assert level_shares(_RANGES, None) == dict.fromkeys(_RANGES, 0.25)
    assert level_shares({1: (9.0, 64.0)}, _around(2.9)) == {1: 1.0}
