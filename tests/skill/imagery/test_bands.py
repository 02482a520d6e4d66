from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.skill.imagery.files import (
    RGB,
    encoded,
    geotiff,
    read_all,
)
from vehanchor.errors import (
    InvalidParameterError,
)
from vehanchor.imagery.sources.opening import open_raster


def test_bands_choose_red_green_and_blue() -> None:
    five = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)
    with open_raster(five) as raster:
        np.testing.assert_array_equal(raster.read(), RGB)
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        assert "5 bands" in raster.warnings[0].message
    with open_raster(five, bands=(5, 1, 4)) as raster:
        np.testing.assert_array_equal(raster.read(), five[..., [4, 0, 3]])
        assert raster.warnings == ()
    np.testing.assert_array_equal(read_all(encoded(".png"), bands=(3, 2, 2)), RGB[..., [2, 1, 1]])


@pytest.mark.parametrize("bands", [(0, 1, 2), (1, 2, 4), (1, 2), (-1, 1, 1), (1.0, 2.0, 3.0), "123"])
def test_bands_that_are_not_there_are_a_wrong_parameter(bands: Any) -> None:
    for image in (RGB, encoded(".png")):
        with pytest.raises(InvalidParameterError):
            open_raster(image, bands=bands)


def test_more_than_four_bands_are_read_through_rasterio_and_told(tmp_path: Path) -> None:
    five = np.concatenate([RGB, 255 - RGB[..., :2]], axis=2)
    path = geotiff(tmp_path / "a.tif", five, crs=None, transform=None)
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        assert [note.code for note in raster.warnings] == ["bands_selected"]
        np.testing.assert_array_equal(raster.read(), RGB)
    np.testing.assert_array_equal(read_all(path, bands=(5, 5, 1)), five[..., [4, 4, 0]])
