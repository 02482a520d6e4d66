from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.imagery.tiles import tile_grid


@given(st.integers(1, 400), st.integers(1, 400), st.integers(32, 128), st.floats(0.1, 1.0))
def test_tiles_cover_every_pixel_once_each_and_stay_inside(width: int, height: int, tile: int, share: float) -> None:
    tiles = tile_grid(width, height, tile_px=tile, stride_px=max(1, round(tile * share)))
    covered = np.zeros((height, width), dtype=bool)
    for t in tiles:
        assert t.x_px >= 0
        assert t.y_px >= 0
        assert t.x_px + t.width_px <= width
        assert t.y_px + t.height_px <= height
        covered[t.y_px : t.y_px + t.height_px, t.x_px : t.x_px + t.width_px] = True
    assert covered.all()
    assert len({(t.x_px, t.y_px) for t in tiles}) == len(tiles)


def test_the_papers_grid_on_a_4096_px_image() -> None:
    tiles = tile_grid(4096, 4096)
    assert len(tiles) == 25
    assert sorted({t.x_px for t in tiles}) == [0, 768, 1536, 2304, 3072]


def test_the_last_row_and_column_are_flush_with_the_edge() -> None:
    tiles = tile_grid(1500, 1100)
    assert sorted({t.x_px for t in tiles}) == [0, 476]
    assert sorted({t.y_px for t in tiles}) == [0, 76]


def test_a_small_image_is_one_tile_of_its_own_size() -> None:
    (tile,) = tile_grid(256, 100)
    assert (tile.width_px, tile.height_px) == (256, 100)
