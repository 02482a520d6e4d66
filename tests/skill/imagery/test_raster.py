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
    jpeg_with,
    png_with,
    read_all,
    tiff_with,
    webp_with,
)
from vehanchor.errors import (
    InvalidParameterError,
)
from vehanchor.imagery.raster import Window, outer_sides
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
@pytest.mark.parametrize("make", [jpeg_with, png_with, webp_with, tiff_with])
def test_the_orientation_tag_is_honoured(make: Callable[[int], bytes], orientation: int) -> None:
    expected = UPRIGHT[orientation](RGB)
    with open_raster(make(orientation)) as raster:
        assert (raster.height_px, raster.width_px) == expected.shape[:2]
        assert np.abs(raster.read().astype(int) - expected).max() <= 4
        window = Window(3, 5, 20, 7)
        assert np.abs(raster.read(window).astype(int) - expected[5:12, 3:23]).max() <= 4


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_tiff_read_by_windows_is_turned_like_one_decoded_whole(orientation: int) -> None:
    data = tiff_with(orientation)
    limits = ImageLimits(max_pixels=WIDTH_PX * HEIGHT_PX - 1)
    np.testing.assert_array_equal(read_all(data, limits=limits), read_all(data))


@pytest.mark.parametrize(
    "window",
    [Window(-1, 0, 4, 4), Window(0, 0, WIDTH_PX + 1, 4), Window(0, 37, 4, 4), Window(0, 0, 0, 4), Window(5, 5, 3, -1)],
)
def test_a_window_that_is_not_inside_is_a_wrong_parameter(window: Window) -> None:
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
    x, y = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    w, h = data.draw(st.integers(1, width - x)), data.draw(st.integers(1, height - y))
    with open_raster(windowed_file) as raster:
        whole = raster.read()
        part = raster.read(Window(x, y, w, h))
    assert part.flags.c_contiguous
    np.testing.assert_array_equal(part, whole[y : y + h, x : x + w])


@pytest.mark.parametrize(
    ("window", "sides"),
    [
        (Window(0, 0, 60, 40), (True, True, True, True)),
        (Window(0, 5, 20, 20), (True, False, False, False)),
        (Window(5, 0, 20, 20), (False, True, False, False)),
        (Window(40, 5, 20, 20), (False, False, True, False)),
        (Window(5, 20, 20, 20), (False, False, False, True)),
        (Window(5, 5, 20, 20), (False, False, False, False)),
    ],
)
def test_a_window_knows_which_of_its_sides_are_the_images(window: Window, sides: tuple[bool, bool, bool, bool]) -> None:
    assert outer_sides(window, WIDTH_PX, HEIGHT_PX) == sides
