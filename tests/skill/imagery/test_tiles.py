from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vehanchor.imagery.raster import Raster, Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_reduced_window, tile_grid


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


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_a_reduced_window_is_the_mean_of_blocks_and_is_read_in_small_pieces(
    factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = np.random.default_rng(0).integers(0, 256, (600, 2300, 3), dtype=np.uint8)
    read: list[Window] = []
    whole = Raster.read

    def spy(self: Raster, window: Window | None = None) -> NDArray[np.uint8]:
        assert window is not None
        read.append(window)
        return whole(self, window)

    monkeypatch.setattr(Raster, "read", spy)
    window = Window(3, 5, 2300 // factor - 7, 600 // factor - 9)
    with open_raster(image) as raster:
        reduced = read_reduced_window(raster, window, factor)
    part = image[: 600 // factor * factor, : 2300 // factor * factor].astype(np.float64)
    mean = part.reshape(600 // factor, factor, 2300 // factor, factor, 3).mean(axis=(1, 3))
    expected = mean[5 : 5 + window.height_px, 3 : 3 + window.width_px]
    assert np.abs(reduced - expected).max() <= 0.75  # rounding to whole grey levels
    if factor > 1:
        assert max(max(w.width_px, w.height_px) for w in read) <= 1024
