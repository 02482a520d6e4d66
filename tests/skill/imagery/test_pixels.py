"""Pixels of open images: bands, stretched values, transparency and no-data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image
from rasterio.enums import ColorInterp

from tests.skill.imagery.files import (
    HEIGHT_PX,
    NOISE,
    RGB,
    WIDTH_PX,
    encoded,
    geotiff,
    pillow,
    read_all,
)
from vehanchor.errors import ImageFormatError, InvalidParameterError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Reading

LEFT = np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8)
LEFT[:, :20] = 0
RGBA = np.dstack([RGB, LEFT])
NEAR_INFRARED = np.dstack([RGB, np.where(LEFT == 0, 0, RGB[..., 0])]).astype(np.uint8)


def _declared(path: Path, image: NDArray[Any], kind: ColorInterp, **profile: Any) -> Path:
    """Write a GeoTIFF whose fourth band is declared to be of a kind."""
    geotiff(path, image, photometric="rgb", **profile)
    with rasterio.open(path, "r+") as dataset:
        dataset.colorinterp = (*dataset.colorinterp[:3], kind)
    return path


@pytest.mark.parametrize(
    "make",
    [
        lambda path: pillow("PNG", "RGBA", RGBA),
        lambda path: pillow("WEBP", "RGBA", RGBA, lossless=True),
        lambda path: pillow("TIFF", "RGBA", RGBA),
        lambda path: Image.fromarray(RGBA),
        lambda path: Image.fromarray(RGBA).convert("RGBA").quantize(250),
        lambda path: RGBA,
        lambda path: _declared(path, RGBA, ColorInterp.alpha),
        lambda path: _declared(path, RGBA, ColorInterp.alpha, nodata=255),
        lambda path: _declared(path, RGBA, ColorInterp.undefined),
        lambda path: _declared(path, RGBA.astype(np.uint16), ColorInterp.undefined),
    ],
)
def test_transparent_pixels_are_black(make: Callable[[Path], Any], tmp_path: Path) -> None:
    pixels = read_all(make(tmp_path / "a.tif"))
    assert not pixels[:, :20].any()
    assert pixels[:, 20:].any(axis=2).all()


GREY_WITH_ALPHA = np.dstack([RGB[..., 0], LEFT])
DEEP_RGBA = RGBA.astype(np.uint16) * 257
DEEP_RGBA[:, :20, :3] = 65535


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(GREY_WITH_ALPHA, id="grey array"),
        pytest.param(pillow("PNG", "LA", GREY_WITH_ALPHA), id="grey file"),
        pytest.param(DEEP_RGBA, id="deep array"),
        pytest.param(encoded(".png", np.roll(DEEP_RGBA, 1, axis=2)), id="deep file"),
    ],
)
def test_transparent_pixels_of_grey_or_deep_images_are_black(image: Any) -> None:
    pixels = read_all(image)
    assert not pixels[:, :20].any()
    assert pixels[:, 25].any()


def test_transparent_pixels_do_not_change_the_stretch() -> None:
    visible = DEEP_RGBA[:, 20:, :3]
    np.testing.assert_array_equal(read_all(DEEP_RGBA)[:, 20:], read_all(visible))


def test_half_transparent_pixels_stay() -> None:
    half = np.dstack([RGB, np.where(LEFT == 0, 1, 128)]).astype(np.uint8)
    np.testing.assert_array_equal(read_all(pillow("PNG", "RGBA", half)), RGB)


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda path: NEAR_INFRARED, id="array"),
        pytest.param(lambda path: _declared(path, NEAR_INFRARED, ColorInterp.undefined), id="file"),
    ],
)
def test_a_fourth_band_of_many_values_is_near_infrared(
    make: Callable[[Path], Any], tmp_path: Path
) -> None:
    image = make(tmp_path / "a.tif")
    np.testing.assert_array_equal(read_all(image), RGB)
    assert read_all(image, bands=(4, 1, 2))[:, 25].any()


def test_a_fourth_band_of_zeros_is_not_alpha() -> None:
    np.testing.assert_array_equal(read_all(np.dstack([RGB, np.zeros_like(LEFT)])), RGB)


def test_an_alpha_band_that_is_read_as_a_colour_hides_nothing() -> None:
    np.testing.assert_array_equal(read_all(RGBA, bands=(1, 2, 4))[..., :2], RGB[..., :2])


def test_an_image_of_transparent_pixels_is_refused() -> None:
    transparent = np.dstack([RGB, np.zeros_like(LEFT)])
    with pytest.raises(ImageFormatError, match="transparent"):
        open_raster(pillow("PNG", "RGBA", transparent))


NO_DATA = [
    ("float32", -9999),
    ("float32", -3.4e38),
    ("float64", 1.7e308),
    ("uint16", 65535),
    ("float32", 1e20),
]


def _filled(values: NDArray[Any], no_data: float) -> NDArray[Any]:
    filled = values.copy()
    filled[:4] = no_data
    return filled


def _as_file(path: Path, values: NDArray[Any]) -> Path:
    return geotiff(path, values)


def _as_array(path: Path, values: NDArray[Any]) -> NDArray[Any]:
    return values


@pytest.mark.parametrize(("dtype", "no_data"), NO_DATA)
@pytest.mark.parametrize("make", [_as_array, _as_file])
def test_a_value_far_from_all_others_is_no_data(
    make: Callable[[Path, NDArray[Any]], Any], dtype: str, no_data: float, tmp_path: Path
) -> None:
    values = (RGB.astype(dtype) * 8) + 500
    pixels = read_all(make(tmp_path / "a.tif", _filled(values, no_data)))
    assert not pixels[:4].any()
    np.testing.assert_array_equal(pixels[4:], read_all(values[4:]))


@pytest.mark.parametrize(("dtype", "no_data"), NO_DATA)
@pytest.mark.parametrize("make", [_as_array, _as_file])
def test_a_warning_names_the_value_of_no_data(
    make: Callable[[Path, NDArray[Any]], Any], dtype: str, no_data: float, tmp_path: Path
) -> None:
    values = (RGB.astype(dtype) * 8) + 500
    image = make(tmp_path / "a.tif", _filled(values, no_data))
    with open_raster(image) as raster:
        message = raster.warnings[0].message
    assert f"the value {no_data:g}, in 10 % of the pixels, counts as no data" in message


def test_a_warning_names_no_data_without_a_stretch() -> None:
    reflectances = _filled(RGB / np.float32(255), -9999)
    with open_raster(reflectances) as raster:
        np.testing.assert_array_equal(raster.read()[4:], RGB[4:])
        assert [note.message for note in raster.warnings] == [
            "the value -9999, in 10 % of the pixels, counts as no data"
        ]


TWELVE_BITS = NOISE.astype(np.uint16) * 16


def _has_no_data(values: NDArray[Any]) -> bool:
    with open_raster(values) as raster:
        return "no data" in raster.warnings[0].message


def _with_rows(share: float, value: int) -> NDArray[np.uint16]:
    """Set a share of the rows to a value."""
    values = TWELVE_BITS.copy()
    values[: round(share * len(values))] = value
    return values


@pytest.mark.parametrize("share", [0.01, 0.1])
@pytest.mark.parametrize("value", [4095, 0])
def test_clipped_values_are_data(value: int, share: float) -> None:
    assert not _has_no_data(_with_rows(share, value))


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_a_far_value_of_one_band_is_data(share: float) -> None:
    one_band = TWELVE_BITS.copy()
    one_band[..., 0] = _with_rows(share, 65535)[..., 0]
    assert not _has_no_data(one_band)


def test_a_far_value_of_a_few_pixels_is_data() -> None:
    assert not _has_no_data(_with_rows(0.01, 65535))


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_stretched_by_percentiles(suffix: str) -> None:
    twelve_bits = RGB.astype(np.uint16) * 16 + 7
    with open_raster(encoded(suffix, twelve_bits)) as raster:
        pixels = raster.read()
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
    low, high = (float(value) for value in np.percentile(twelve_bits, (2, 98), method="nearest"))
    expected = np.rint(np.clip((twelve_bits - low) / (high - low), 0, 1) * 255)
    np.testing.assert_allclose(pixels, expected, atol=1)
    np.testing.assert_array_equal(pixels, read_all(twelve_bits))


@pytest.mark.parametrize("dtype", ["float16", ">f2", ">u2", ">f4", "uint16", "float64"])
def test_every_type_of_pixels_gives_the_same_picture(dtype: str) -> None:
    array = (RGB.astype(int) * 3).astype(dtype)
    np.testing.assert_array_equal(read_all(array), read_all(array.astype(np.float64)))


def test_one_bright_pixel_does_not_turn_the_picture_black() -> None:
    array = np.zeros((30, 30), np.uint16)
    array[4, 5] = 60000
    pixels = read_all(array)
    assert pixels[4, 5].tolist() == [255, 255, 255]
    assert pixels.sum() == 3 * 255


def test_a_large_array_is_stretched_from_a_sample_spread_over_all_of_it() -> None:
    ramp = np.linspace(1000, 3000, 1500).astype(np.uint16)
    with open_raster(np.tile(ramp, (1200, 1))) as raster:
        row = raster.read(Window(0, 600, width_px=1500, height_px=1))[0, :, 0]
    first_above_black = int(np.argmax(row > 0))
    first_white = int(np.argmax(row == 255))
    assert abs(first_above_black - 30) <= 8
    assert abs(first_white - 1470) <= 8


def test_values_without_data_do_not_take_part_in_the_stretch(tmp_path: Path) -> None:
    values = RGB.astype(np.uint16) * 20
    values[:20] = 0
    pixels = read_all(geotiff(tmp_path / "a.tif", values, nodata=0))
    np.testing.assert_array_equal(pixels[20:], read_all(values[20:]))
    assert not pixels[:20].any()


@pytest.fixture(scope="module")
def ramp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ramp = np.tile(np.linspace(1000, 3000, 1500).astype(np.uint16), (1200, 1))
    path = tmp_path_factory.mktemp("ramp") / "a.tif"
    return geotiff(path, ramp[..., np.newaxis], tiled=True, compress="deflate")


def test_a_large_raster_is_stretched_alike_in_all_windows(ramp_path: Path) -> None:
    with open_raster(ramp_path) as raster:
        whole = raster.read()
        part = raster.read(Window(700, 100, width_px=300, height_px=200))
    np.testing.assert_array_equal(part, whole[100:300, 700:1000])


def test_a_large_raster_is_stretched_to_its_extremes(ramp_path: Path) -> None:
    with open_raster(ramp_path) as raster:
        whole = raster.read()
    assert whole[0, 10].max() == 0
    assert whole[0, -10].min() == 255


FIVE_BANDS = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)


def test_the_first_three_of_more_bands_are_read() -> None:
    np.testing.assert_array_equal(read_all(FIVE_BANDS), RGB)


def test_a_warning_says_that_bands_were_selected() -> None:
    with open_raster(FIVE_BANDS) as raster:
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        assert "5 bands" in raster.warnings[0].message


def test_bands_choose_the_colours() -> None:
    expected = FIVE_BANDS[..., [4, 0, 3]]
    np.testing.assert_array_equal(read_all(FIVE_BANDS, bands=(5, 1, 4)), expected)
    np.testing.assert_array_equal(read_all(encoded(".png"), bands=(3, 2, 2)), RGB[..., [2, 1, 1]])


def test_chosen_bands_need_no_warning() -> None:
    with open_raster(FIVE_BANDS, Reading(bands=(5, 1, 4))) as raster:
        assert raster.warnings == ()


@pytest.mark.parametrize("bands", [(0, 1, 2), (1, 2, 4), (1, 2), (-1, 1, 1), "123"])
@pytest.mark.parametrize("image", [RGB, encoded(".png")], ids=["array", "file"])
def test_missing_bands_are_a_wrong_parameter(image: Any, bands: Any) -> None:
    with pytest.raises(InvalidParameterError):
        open_raster(image, Reading(bands=bands))


def test_bands_above_the_third_can_be_chosen_from_an_array_in_bgr_order() -> None:
    array = np.random.default_rng(3).integers(0, 256, (30, 40, 5), dtype=np.uint8)
    pixels = read_all(array, bgr=True, bands=(1, 2, 5))
    np.testing.assert_array_equal(pixels, array[..., [2, 1, 4]])


def test_whole_numbers_of_32_bits_of_pillow_are_stretched() -> None:
    ramp = np.arange(40 * 60, dtype=np.int32).reshape(40, 60) * 20
    pixels = read_all(Image.fromarray(ramp))
    assert pixels[0, 0, 0] == 0
    assert pixels[-1, -1, 0] == 255
    assert len(np.unique(pixels)) > 200
