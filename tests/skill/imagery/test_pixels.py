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


def test_half_transparent_pixels_are_seen() -> None:
    half = np.dstack([RGB, np.where(LEFT == 0, 1, 128)]).astype(np.uint8)
    np.testing.assert_array_equal(read_all(pillow("PNG", "RGBA", half)), RGB)


def test_a_fourth_band_of_many_values_is_near_infrared(tmp_path: Path) -> None:
    for image in (
        NEAR_INFRARED,
        _declared(tmp_path / "a.tif", NEAR_INFRARED, ColorInterp.undefined),
    ):
        np.testing.assert_array_equal(read_all(image), RGB)
        assert read_all(image, bands=(4, 1, 2))[:, 25].any()
    np.testing.assert_array_equal(read_all(np.dstack([RGB, np.zeros_like(LEFT)])), RGB)


def test_an_alpha_band_that_is_chosen_does_not_hide() -> None:
    np.testing.assert_array_equal(read_all(RGBA, bands=(1, 2, 4))[..., :2], RGB[..., :2])


def test_an_image_without_any_seen_pixel_is_refused() -> None:
    with pytest.raises(ImageFormatError, match="transparent"):
        open_raster(pillow("PNG", "RGBA", np.dstack([RGB, np.zeros_like(LEFT)])))


@pytest.mark.parametrize(
    ("dtype", "no_data"),
    [
        ("float32", -9999),
        ("float32", -3.4e38),
        ("float64", 1.7e308),
        ("uint16", 65535),
        ("float32", 1e20),
    ],
)
def test_a_value_far_from_all_others_is_no_data_and_named(
    dtype: str, no_data: float, tmp_path: Path
) -> None:
    values = (RGB.astype(dtype) * 8) + 500
    filled = values.copy()
    filled[:4] = no_data
    for image in (filled, geotiff(tmp_path / "a.tif", filled)):
        with open_raster(image) as raster:
            shown = raster.read()
            assert (
                f"the value {no_data:g}, in 10 % of the pixels, counts as no data"
                in raster.warnings[0].message
            )
        assert not shown[:4].any()
        np.testing.assert_array_equal(shown[4:], read_all(values[4:]))


def test_no_data_beside_reflectances_is_told_though_nothing_is_stretched() -> None:
    values = RGB / np.float32(255)
    values[:4] = -9999
    with open_raster(values) as raster:
        np.testing.assert_array_equal(raster.read()[4:], RGB[4:])
        assert [note.message for note in raster.warnings] == [
            "the value -9999, in 10 % of the pixels, counts as no data"
        ]


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_clipped_highlights_dead_pixels_and_single_bands_stay(share: float) -> None:
    values = NOISE.astype(np.uint16) * 16
    rows = round(share * len(values))
    for change in (4095, 0):
        clipped = values.copy()
        clipped[:rows] = change
        with open_raster(clipped) as raster:
            assert "no data" not in raster.warnings[0].message
    one_band = values.copy()
    one_band[:rows, :, 0] = 65535
    with open_raster(one_band) as raster:
        assert "no data" not in raster.warnings[0].message
    if share < 0.02:
        values[:rows] = 65535
        with open_raster(values) as raster:
            assert "no data" not in raster.warnings[0].message


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_are_stretched_by_percentiles_and_not_shifted(suffix: str) -> None:
    twelve_bit = RGB.astype(np.uint16) * 16 + 7
    with open_raster(encoded(suffix, twelve_bit)) as raster:
        shown = raster.read()
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
    low, high = np.percentile(twelve_bit, (2, 98), method="nearest")
    expected = np.rint(np.clip((twelve_bit - float(low)) / (float(high) - low), 0, 1) * 255)
    np.testing.assert_allclose(shown, expected, atol=1)
    np.testing.assert_array_equal(shown, read_all(twelve_bit))


@pytest.mark.parametrize("dtype", ["float16", ">u2", ">f4", "uint16", "float64"])
def test_depths_and_byte_orders_give_the_same_picture(dtype: str) -> None:
    array = (RGB.astype(int) * 3).astype(dtype)
    np.testing.assert_array_equal(read_all(array), read_all(array.astype(np.float64)))


def test_one_bright_pixel_does_not_turn_the_picture_black() -> None:
    array = np.zeros((30, 30), np.uint16)
    array[4, 5] = 60000
    shown = read_all(array)
    assert shown[4, 5].tolist() == [255, 255, 255]
    assert shown.sum() == 3 * 255


def test_a_large_array_is_stretched_from_a_sample_spread_over_all_of_it() -> None:
    ramp = np.linspace(1000, 3000, 1500).astype(np.uint16)
    with open_raster(np.tile(ramp, (1200, 1))) as raster:
        row = raster.read(Window(0, 600, width_px=1500, height_px=1))[0, :, 0].astype(int)
    assert abs(int(np.argmax(row > 0)) - 30) <= 8
    assert abs(int(np.argmax(row == 255)) - 1470) <= 8


def test_values_without_data_do_not_take_part_in_the_stretch(tmp_path: Path) -> None:
    values = RGB.astype(np.uint16) * 20
    values[:20] = 0
    shown = read_all(geotiff(tmp_path / "a.tif", values, nodata=0))
    np.testing.assert_array_equal(shown[20:], read_all(values[20:]))
    assert not shown[:20].any()


def test_a_large_raster_is_stretched_alike_in_all_windows(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(1000, 3000, 1500).astype(np.uint16), (1200, 1))
    path = geotiff(tmp_path / "a.tif", ramp[..., np.newaxis], tiled=True, compress="deflate")
    with open_raster(path) as raster:
        whole = raster.read()
        np.testing.assert_array_equal(
            raster.read(Window(700, 100, width_px=300, height_px=200)), whole[100:300, 700:1000]
        )
    assert whole[0, 10].max() == 0
    assert whole[0, -10].min() == 255


def test_bands_choose_red_green_and_blue() -> None:
    five = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)
    with open_raster(five) as raster:
        np.testing.assert_array_equal(raster.read(), RGB)
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        assert "5 bands" in raster.warnings[0].message
    with open_raster(five, Reading(bands=(5, 1, 4))) as raster:
        np.testing.assert_array_equal(raster.read(), five[..., [4, 0, 3]])
        assert raster.warnings == ()
    np.testing.assert_array_equal(read_all(encoded(".png"), bands=(3, 2, 2)), RGB[..., [2, 1, 1]])


@pytest.mark.parametrize("bands", [(0, 1, 2), (1, 2, 4), (1, 2), (-1, 1, 1), "123"])
def test_bands_that_are_not_there_are_a_wrong_parameter(bands: Any) -> None:
    for image in (RGB, encoded(".png")):
        with pytest.raises(InvalidParameterError):
            open_raster(image, Reading(bands=bands))
