from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vehanchor.imagery.raster import Raster, Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_reduced_window, tile_grid

WIDTH_PX = 2300
HEIGHT_PX = 600
IMAGE = np.random.default_rng(0).integers(0, 256, (HEIGHT_PX, WIDTH_PX, 3), dtype=np.uint8)

SIDES = st.integers(1, 400)
TILE_SIDES = st.integers(32, 128)
STRIDE_SHARES = st.floats(0.1, 1.0)


def _grid(width: int, height: int, tile: int, stride_share: float) -> list[Window]:
    stride = max(1, round(tile * stride_share))
    return tile_grid(width, height, tile_px=tile, stride_px=stride)


@given(SIDES, SIDES, TILE_SIDES, STRIDE_SHARES)
def test_tiles_cover_every_pixel(width: int, height: int, tile: int, stride_share: float) -> None:
    covered = np.zeros((height, width), dtype=bool)
    for window in _grid(width, height, tile, stride_share):
        rows = slice(window.y_px, window.y_px + window.height_px)
        columns = slice(window.x_px, window.x_px + window.width_px)
        covered[rows, columns] = True
    assert covered.all()


@given(SIDES, SIDES, TILE_SIDES, STRIDE_SHARES)
def test_tiles_stay_inside_the_image(
    width: int, height: int, tile: int, stride_share: float
) -> None:
    for window in _grid(width, height, tile, stride_share):
        assert window.x_px >= 0
        assert window.y_px >= 0
        assert window.x_px + window.width_px <= width
        assert window.y_px + window.height_px <= height


@given(SIDES, SIDES, TILE_SIDES, STRIDE_SHARES)
def test_no_tile_occurs_twice(width: int, height: int, tile: int, stride_share: float) -> None:
    tiles = _grid(width, height, tile, stride_share)
    assert len({(window.x_px, window.y_px) for window in tiles}) == len(tiles)


def test_the_papers_grid_on_a_4096_px_image() -> None:
    tiles = tile_grid(4096, 4096)
    assert len(tiles) == 25
    assert sorted({window.x_px for window in tiles}) == [0, 768, 1536, 2304, 3072]


def _reduced_window(factor: int) -> Window:
    return Window(3, 5, width_px=WIDTH_PX // factor - 7, height_px=HEIGHT_PX // factor - 9)


@pytest.mark.parametrize("factor", [1, 2, 8])
def test_a_reduced_window_is_the_mean_of_blocks(factor: int) -> None:
    window = _reduced_window(factor)
    with open_raster(IMAGE) as raster:
        reduced = read_reduced_window(raster, window, factor)
    rows = HEIGHT_PX // factor
    columns = WIDTH_PX // factor
    whole_blocks = IMAGE[: rows * factor, : columns * factor].astype(np.float64)
    mean = whole_blocks.reshape(rows, factor, columns, factor, 3).mean(axis=(1, 3))
    expected = mean[5 : 5 + window.height_px, 3 : 3 + window.width_px]
    assert np.abs(reduced - expected).max() <= 0.75  # rounding to whole grey levels


@pytest.mark.parametrize("factor", [2, 8])
def test_a_reduced_window_is_read_in_small_pieces(
    factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    windows: list[Window] = []
    read = Raster.read

    def spy(self: Raster, window: Window | None = None) -> NDArray[np.uint8]:
        assert window is not None
        windows.append(window)
        return read(self, window)

    monkeypatch.setattr(Raster, "read", spy)
    with open_raster(IMAGE) as raster:
        read_reduced_window(raster, _reduced_window(factor), factor)
    assert max(max(window.width_px, window.height_px) for window in windows) <= 1024
