"""Pixels that show nothing: transparent ones, and those of a no-data value without a tag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from rasterio.enums import ColorInterp

from tests.skill.imagery.files import HEIGHT_PX, NOISE, RGB, WIDTH_PX, encoded, geotiff, pillow, read_all
from vehanchor.errors import ImageFormatError
from vehanchor.imagery.sources.opening import open_raster

LEFT = np.full((HEIGHT_PX, WIDTH_PX), 255, np.uint8)
LEFT[:, :20] = 0
RGBA = np.dstack([RGB, LEFT])
NEAR_INFRARED = np.dstack([RGB, np.where(LEFT == 0, 0, RGB[..., 0])]).astype(np.uint8)


def _declared(path: Path, image: NDArray[Any], kind: ColorInterp, **profile: Any) -> Path:
    import rasterio

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
def test_transparent_pixels_are_not_seen(make: Callable[[Path], Any], tmp_path: Path) -> None:
    shown = read_all(make(tmp_path / "a.tif"))
    assert not shown[:, :20].any()
    assert shown[:, 20:].any(axis=2).all()


def test_transparent_pixels_of_grey_and_deep_images_are_not_seen_either() -> None:
    grey = np.dstack([RGB[..., 0], LEFT])
    deep = RGBA.astype(np.uint16) * 257
    deep[:, :20, :3] = 65535
    for image in (grey, pillow("PNG", "LA", grey), deep, encoded(".png", np.roll(deep, 1, axis=2))):
        shown = read_all(image)
        assert not shown[:, :20].any()
        assert shown[:, 25].any()
    np.testing.assert_array_equal(read_all(deep)[:, 20:], read_all(deep[:, 20:, :3]))


def test_half_transparent_pixels_are_seen() -> None:
    half = np.dstack([RGB, np.where(LEFT == 0, 1, 128)]).astype(np.uint8)
    np.testing.assert_array_equal(read_all(pillow("PNG", "RGBA", half)), RGB)


def test_a_fourth_band_of_many_values_is_near_infrared(tmp_path: Path) -> None:
    for image in (NEAR_INFRARED, _declared(tmp_path / "a.tif", NEAR_INFRARED, ColorInterp.undefined)):
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
    [("float32", -9999), ("float32", -3.4e38), ("float64", 1.7e308), ("uint16", 65535), ("float32", 1e20)],
)
def test_a_value_far_from_all_others_is_no_data_and_named(dtype: str, no_data: float, tmp_path: Path) -> None:
    values = (RGB.astype(dtype) * 8) + 500
    filled = values.copy()
    filled[:4] = no_data
    for image in (filled, geotiff(tmp_path / "a.tif", filled)):
        with open_raster(image) as raster:
            shown = raster.read()
            assert f"the value {no_data:g}, in 10% of the pixels, counts as no data" in raster.warnings[0].message
        assert not shown[:4].any()
        np.testing.assert_array_equal(shown[4:], read_all(values[4:]))


def test_no_data_beside_reflectances_is_told_though_nothing_is_stretched() -> None:
    values = RGB / np.float32(255)
    values[:4] = -9999
    with open_raster(values) as raster:
        np.testing.assert_array_equal(raster.read()[4:], RGB[4:])
        assert [note.message for note in raster.warnings] == [
            "the value -9999, in 10% of the pixels, counts as no data"
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
