from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models import blank_image
from tests.skill.imagery.files import (
    HEIGHT_PX,
    NOISE,
    RGB,
    WIDTH_PX,
    encoded,
    geotiff,
    jpeg_of_a_mac_with,
    jpeg_with,
    png_with,
    read_all,
    tiff_with,
    webp_with,
)
from vehanchor.errors import (
    InvalidParameterError,
)
from vehanchor.imagery.detail import PATCH_PX, measure_detail_share, ring_spectrum, spectrum_share
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.raster import Raster, Window
from vehanchor.imagery.sources.opening import ImageSource, open_raster
from vehanchor.imagery.tiles import read_reduced_window, tile_grid
from vehanchor.options import ImageLimits, Reading

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
    expected = UPRIGHT[orientation](RGB)
    with open_raster(make(orientation)) as raster:
        assert (raster.height_px, raster.width_px) == expected.shape[:2]
        assert np.abs(raster.read().astype(int) - expected).max() <= 4
        window = Window(3, 5, width_px=20, height_px=7)
        assert np.abs(raster.read(window).astype(int) - expected[5:12, 3:23]).max() <= 4


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
    x = data.draw(st.integers(0, width - 1))
    y = data.draw(st.integers(0, height - 1))
    w = data.draw(st.integers(1, width - x))
    h = data.draw(st.integers(1, height - y))
    with open_raster(windowed_file) as raster:
        whole = raster.read()
        part = raster.read(Window(x, y, width_px=w, height_px=h))
    assert part.flags.c_contiguous
    np.testing.assert_array_equal(part, whole[y : y + h, x : x + w])


@given(st.integers(1, 400), st.integers(1, 400), st.integers(32, 128), st.floats(0.1, 1.0))
def test_tiles_cover_every_pixel_once_each_and_stay_inside(
    width: int, height: int, tile: int, share: float
) -> None:
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


@pytest.mark.parametrize("factor", [1, 2, 8])
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
    window = Window(3, 5, width_px=2300 // factor - 7, height_px=600 // factor - 9)
    with open_raster(image) as raster:
        reduced = read_reduced_window(raster, window, factor)
    part = image[: 600 // factor * factor, : 2300 // factor * factor].astype(np.float64)
    mean = part.reshape(600 // factor, factor, 2300 // factor, factor, 3).mean(axis=(1, 3))
    expected = mean[5 : 5 + window.height_px, 3 : 3 + window.width_px]
    assert np.abs(reduced - expected).max() <= 0.75  # rounding to whole grey levels
    if factor > 1:
        assert max(max(w.width_px, w.height_px) for w in read) <= 1024


READ_WHOLE = Reading()
WINDOWED = Reading(limits=ImageLimits(max_pixels=1_000_000))
# along the longer side, a window of 512 px every 600 px
SIDE_PX = 4800
UNREAD_PX = 560


def _id(source: ImageSource, reading: Reading = READ_WHOLE) -> str:
    with open_raster(source, reading) as raster:
        return image_id(raster)


def test_two_large_images_that_differ_in_one_pixel_have_two_ids(tmp_path: Path) -> None:
    array = np.full((512, SIDE_PX, 3), 90, np.uint8)
    other = array.copy()
    other[100, UNREAD_PX] = 91
    first, second = (
        geotiff(tmp_path / f"{name}.tif", pixels, tiled=True, blockxsize=256, blockysize=256)
        for name, pixels in (("first", array), ("second", other))
    )
    assert first.stat().st_size == second.stat().st_size
    assert _id(first, WINDOWED) != _id(second, WINDOWED)
    assert _id(first, WINDOWED) == _id(first.read_bytes(), WINDOWED)
    assert _id(array) != _id(other)


def test_a_path_its_bytes_and_its_array_have_one_id(tmp_path: Path) -> None:
    pixels = np.random.default_rng(3).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    path.write_bytes(encoded(".png", pixels))
    assert _id(path) == _id(path.read_bytes()) == _id(pixels)
    assert _id(pixels) != _id(pixels[:, ::-1])


def _texture(side: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture with edges at all scales: overlapping rectangles, power falling with the square of the frequency."""
    rng = np.random.default_rng(seed)
    image = np.full((side, side, 3), 120, np.uint8)
    for _ in range(side * 3):
        x, y = rng.integers(0, side, 2)
        w, h = np.exp(rng.uniform(0.5, 4, 2)).astype(int) + 1
        cv2.rectangle(
            image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1
        )
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4), dtype=np.uint8)


def _share(image: NDArray[np.uint8]) -> float:
    step = PATCH_PX // 2
    return spectrum_share(
        ring_spectrum(
            image[y : y + PATCH_PX, x : x + PATCH_PX]
            for y in range(0, image.shape[0] - PATCH_PX, step)
            for x in range(0, image.shape[1] - PATCH_PX, step)
        )
    )


@pytest.mark.parametrize(
    ("factor", "way"), [(2, cv2.INTER_LINEAR), (3, cv2.INTER_CUBIC), (4, cv2.INTER_LANCZOS4)]
)
def test_an_enlarged_image_has_the_detail_of_its_original(factor: int, way: int) -> None:
    original = _texture(128)
    assert _share(original) == 1.0
    enlarged = np.asarray(
        cv2.resize(original, None, fx=factor, fy=factor, interpolation=way), dtype=np.uint8
    )
    assert _share(enlarged) == pytest.approx(1 / factor, rel=0.75)
    assert _share(enlarged) < 0.8


def test_compression_and_a_flat_image_are_no_missing_detail() -> None:
    _, coded = cv2.imencode(".jpg", _texture(256), [cv2.IMWRITE_JPEG_QUALITY, 60])
    assert _share(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)) == 1.0
    assert _share(blank_image(200, 200)) == 1.0
    with open_raster(blank_image(40, 40)) as raster:
        assert measure_detail_share(raster, np.array([[20.0, 20.0]])) == 1.0
    with open_raster(_texture(128)) as raster:
        assert measure_detail_share(raster, np.zeros((0, 2))) == 1.0


def test_detail_is_looked_for_in_the_copy_in_which_the_vehicles_were_found() -> None:
    original = _texture(256)
    enlarged = cv2.resize(original, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    centres = np.random.default_rng(0).uniform(100, 900, (20, 2))
    with open_raster(np.asarray(enlarged, dtype=np.uint8)) as raster:
        assert measure_detail_share(raster, centres, 1.0) < 0.5
        assert measure_detail_share(raster, centres, 0.25) == 1.0
