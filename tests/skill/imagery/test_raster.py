from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.skill.imagery.files import (
    HEIGHT_PX,
    NOISE,
    RGB,
    WIDTH_PX,
    geotiff,
    jpeg_of_a_mac_with,
    jpeg_with,
    png_with,
    read_all,
    tiff_with,
    webp_with,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits

UPRIGHT: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: np.rot90(a, 1),
}


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("make", [jpeg_with, jpeg_of_a_mac_with, png_with, webp_with, tiff_with])
def test_the_orientation_tag_is_honoured(make: Callable[[int], bytes], orientation: int) -> None:
    upright = UPRIGHT[orientation](RGB)
    with open_raster(make(orientation)) as raster:
        assert (raster.height_px, raster.width_px) == upright.shape[:2]
        assert np.abs(raster.read().astype(int) - upright).max() <= 4


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("make", [jpeg_with, jpeg_of_a_mac_with, png_with, webp_with, tiff_with])
def test_windows_are_turned_as_the_image(make: Callable[[int], bytes], orientation: int) -> None:
    upright = UPRIGHT[orientation](RGB)
    with open_raster(make(orientation)) as raster:
        part = raster.read(Window(3, 5, width_px=20, height_px=7))
    assert np.abs(part.astype(int) - upright[5:12, 3:23]).max() <= 4


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_tiff_read_by_windows_is_turned_like_one_decoded_whole(orientation: int) -> None:
    data = tiff_with(orientation)
    limits = ImageLimits(max_pixels=WIDTH_PX * HEIGHT_PX - 1)
    np.testing.assert_array_equal(read_all(data, limits=limits), read_all(data))


@pytest.mark.parametrize(
    "window",
    [
        Window(-1, 0, width_px=4, height_px=4),
        Window(0, 0, width_px=WIDTH_PX + 1, height_px=4),
        Window(0, 37, width_px=4, height_px=4),
        Window(0, 0, width_px=0, height_px=4),
        Window(5, 5, width_px=3, height_px=-1),
    ],
)
def test_a_window_must_lie_inside_the_image(window: Window) -> None:
    with open_raster(RGB) as raster, pytest.raises(InvalidParameterError, match="60 x 40"):
        raster.read(window)


@pytest.fixture(scope="module")
def windowed_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("geo") / "tiled.tif"
    mask = np.full(NOISE.shape[:2], 255, np.uint8)
    mask[:20, 100:] = 0
    pixels = NOISE.astype(np.uint16) * 13 + 300
    return geotiff(path, pixels, mask, tiled=True, blockxsize=32, blockysize=16, compress="deflate")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_windows_are_slices_of_the_whole(windowed_file: Path, data: st.DataObject) -> None:
    height, width = NOISE.shape[:2]
    x = data.draw(st.integers(0, width - 1))
    y = data.draw(st.integers(0, height - 1))
    columns = data.draw(st.integers(1, width - x))
    rows = data.draw(st.integers(1, height - y))
    with open_raster(windowed_file) as raster:
        whole = raster.read()
        part = raster.read(Window(x, y, width_px=columns, height_px=rows))
    assert part.flags.c_contiguous
    np.testing.assert_array_equal(part, whole[y : y + rows, x : x + columns])


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("make", [png_with, tiff_with])
def test_pixels_can_be_read_as_stored(make: Callable[[int], bytes], orientation: int) -> None:
    with open_raster(make(orientation)) as raster:
        assert raster.stored_size_px() == (WIDTH_PX, HEIGHT_PX)
        raster.use_stored_pixels()
        assert (raster.width_px, raster.height_px) == (WIDTH_PX, HEIGHT_PX)
        assert np.abs(raster.read().astype(int) - RGB).max() <= 4


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_points_are_turned_as_the_image(orientation: int) -> None:
    upright = UPRIGHT[orientation](np.arange(WIDTH_PX * HEIGHT_PX).reshape(HEIGHT_PX, WIDTH_PX))
    with open_raster(png_with(orientation)) as raster:
        x, y = raster.stored_point(3.5, 5.5)
    assert WIDTH_PX * int(y) + int(x) == upright[5, 3]
