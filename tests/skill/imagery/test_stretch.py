from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.skill.imagery.files import (
    RGB,
    encoded,
    geotiff,
    read_all,
)
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster


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
        row = raster.read(Window(0, 600, 1500, 1))[0, :, 0].astype(int)
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
        np.testing.assert_array_equal(raster.read(Window(700, 100, 300, 200)), whole[100:300, 700:1000])
    assert whole[0, 10].max() == 0
    assert whole[0, -10].min() == 255
