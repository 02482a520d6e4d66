from __future__ import annotations

import math
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.errors import CRSError, NotGeoreferencedWarning
from rasterio.transform import Affine
from rasterio.warp import transform as transform_coordinates

from tests.skill.imagery.files import NOISE, encoded, geotiff
from vehanchor.errors import ImageDecodeError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.formats import decoding
from vehanchor.imagery.metadata.georeference import (
    gsd_units_per_px,
    metres_per_degree,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.sources.rasterio_file import gdal_environment

US_SURVEY_FOOT_M = 1200 / 3937


@pytest.mark.parametrize("latitude_deg", [0.0, 30.0, 43.55, -60.0, 85.0])
def test_a_degree_is_as_long_as_in_proj(latitude_deg: float) -> None:
    step_deg = 1e-4
    centred_here = f"+proj=aeqd +lat_0={latitude_deg} +lon_0=0 +ellps=WGS84"
    longitudes = [0.0, step_deg]
    latitudes = [latitude_deg + step_deg, latitude_deg]
    east, north = transform_coordinates("EPSG:4326", centred_here, longitudes, latitudes)
    expected = (north[0] / step_deg, east[1] / step_deg)
    assert metres_per_degree(latitude_deg) == pytest.approx(expected, rel=1e-5)


def test_a_turned_raster_keeps_its_gsd() -> None:
    turned = Affine.translation(5e5, 5e6) @ Affine.rotation(30) @ Affine.scale(0.2, -0.2)
    coefficients = (turned.a, turned.b, turned.c, turned.d, turned.e, turned.f)
    assert gsd_units_per_px(coefficients) == pytest.approx(0.2)


def test_an_oblong_pixel_counts_by_its_area() -> None:
    assert gsd_units_per_px((0.1, 0, 0, 0, -0.4, 0)) == pytest.approx(0.2)


def test_an_oblong_pixel_in_degrees_can_be_square_on_the_ground(tmp_path: Path) -> None:
    latitude_m, longitude_m = metres_per_degree(60)
    square_on_the_ground = Affine(0.3 / longitude_m, 0.0, 10.0, 0.0, -0.3 / latitude_m, 60.0)
    path = write(tmp_path / "square.tif", "EPSG:4326", square_on_the_ground)
    with open_raster(path) as raster:
        assert raster.grid.is_square
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.3, rel=1e-5)


def write(path: Path, crs: Any, transform: Affine | None) -> Path:
    """Write a black GeoTIFF of 200 x 100 px."""
    with warnings.catch_warnings(), rasterio.Env():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        profile = {"driver": "GTiff", "dtype": "uint8", "crs": crs, "transform": transform}
        with rasterio.open(path, "w", width=200, height=100, count=3, **profile) as dataset:
            dataset.write(np.zeros((3, 100, 200), np.uint8))
    return path


DEGREE_PX = 0.25 / metres_per_degree(43.55)[1]
"""Degrees of longitude of 0.25 m: the shorter side of a pixel that is square in degrees."""
RADIUS_M = 6_378_137.0


def _web_mercator_gsd(northing_m: float) -> float:
    """Compute the GSD of Web Mercator at 0.25 units per pixel.

    The projection is x = R longitude and y = R atanh(sin(latitude)).
    """
    cos_latitude = 1 / math.cosh(northing_m / RADIUS_M)
    latitude_m, longitude_m = metres_per_degree(math.degrees(math.acos(cos_latitude)))
    pixel_deg = math.degrees(0.25 / RADIUS_M)
    return pixel_deg * math.sqrt(cos_latitude * latitude_m * longitude_m)


WEB_PX = _web_mercator_gsd(5_396_000)
TRUE_AT_42 = "+proj=merc +lat_ts=42 +lon_0=0 +ellps=WGS84 +units=m"
(_,), (NORTH_42,) = transform_coordinates("EPSG:4326", TRUE_AT_42, [7.0], [42.0])


@pytest.mark.parametrize(
    ("crs", "transform", "gsd_m_per_px"),
    [
        ("EPSG:32631", Affine(0.25, 0, 5e5, 0, -0.25, 5e6), 0.25),
        ("EPSG:2154", Affine(0.2, 0, 1_020_000, 0, -0.2, 6_280_000), 0.2),
        # The pixels at the centre of the image lie on both sides of the 180th meridian.
        ("EPSG:3832", Affine(0.25, 0, 3_339_559.6, 0, -0.25, 12.5), 0.25),
        # Outside the projection, its unit counts.
        ("EPSG:32631", Affine(1, 0, 9e8, 0, -1, 9e8), 1.0),
        ("EPSG:3035", Affine(0.2, 0, 9e8, 0, -0.2, 9e8), 0.2),
        ("EPSG:2263", Affine(0.5, 0, 980_000, 0, -0.5, 200_000), 0.5 * US_SURVEY_FOOT_M),
        ("EPSG:3857", Affine(0.25, 0, 780_000, 0, -0.25, 5_396_012.5), WEB_PX),
        ("EPSG:3857", Affine(0.25, 0, 780_000, 0, -0.25, -5_395_987.5), WEB_PX),
        (TRUE_AT_42, Affine(0.25, 0, 580_000, 0, -0.25, NORTH_42 + 12.5), 0.25),
        ("EPSG:4326", Affine(DEGREE_PX, 0, 7.0, 0, -DEGREE_PX, 43.55 + 50 * DEGREE_PX), 0.25),
        (
            "EPSG:4807",
            Affine(DEGREE_PX / 0.9, 0, 5.0, 0, -DEGREE_PX / 0.9, (43.55 + 50 * DEGREE_PX) / 0.9),
            0.25,
        ),
    ],
)
def test_the_gsd_of_a_file_is_in_metres_on_the_ground(
    crs: str, transform: Affine, gsd_m_per_px: float, tmp_path: Path
) -> None:
    with open_raster(write(tmp_path / "a.tif", crs, transform)) as raster:
        assert raster.georeference_gsd_m_per_px == pytest.approx(gsd_m_per_px, rel=1e-6)


@pytest.mark.parametrize(
    ("crs", "transform"),
    [
        ("EPSG:4326", Affine(1, 0, 7.0, 0, -1, 200.0)),
        ("EPSG:32631", Affine(0, 0, 5e5, 0, 0, 5e6)),
        ("EPSG:3857", Affine(0.25, 0, 1e300, 0, -0.25, 1e300)),
        ('LOCAL_CS["site",UNIT["metre",1]]', Affine(0.25, 0, 0, 0, -0.25, 10)),
        ("EPSG:32631", None),
        (None, Affine(0.25, 0, 5e5, 0, -0.25, 5e6)),
        (None, None),
    ],
)
def test_without_a_usable_georeference_there_is_no_gsd(
    crs: str | None, transform: Affine | None, tmp_path: Path
) -> None:
    with open_raster(write(tmp_path / "a.tif", crs, transform)) as raster:
        assert raster.georeference_gsd_m_per_px is None


@pytest.mark.parametrize(
    "error",
    [CRSError("bad"), ValueError("NULL color table"), KeyError(7), OverflowError(), OSError()],
)
def test_every_error_of_rasterio_is_an_undecodable_image(error: Exception) -> None:
    with pytest.raises(ImageDecodeError), gdal_environment("a.tif"):
        raise error


def test_lack_of_memory_in_gdal_has_its_own_error() -> None:
    with pytest.raises(OutOfMemoryError), gdal_environment("a.tif"):
        raise MemoryError


def test_lack_of_memory_in_opencv_has_its_own_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: object) -> None:
        error = cv2.error("Insufficient memory")
        error.code = decoding._NO_MEMORY
        error.err = "Insufficient memory"
        raise error

    monkeypatch.setattr(cv2, "imdecode", no_memory)
    with pytest.raises(OutOfMemoryError):
        open_raster(encoded(".png"))


def test_a_geotiff_with_damaged_keys_is_refused_or_read(tmp_path: Path) -> None:
    data = geotiff(tmp_path / "a.tif", NOISE).read_bytes()
    rng = np.random.default_rng(47)
    n_read = 0
    for _ in range(150):
        damaged = bytearray(data)
        # The directory is at the start, the values of the keys are at the end.
        for position in rng.integers(0, 600, 3):
            is_at_start = position < 300
            index = position if is_at_start else len(data) - position + 299
            damaged[index] = rng.integers(0, 256)
        with suppress(VehAnchorError), open_raster(bytes(damaged)) as raster:
            assert raster.width_px
            n_read += 1
    assert n_read > 10
