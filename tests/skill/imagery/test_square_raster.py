"""Images whose file states that pixels are not square: sizes, pixels, windows, overviews."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.control import GroundControlPoint
from rasterio.crs import CRS
from rasterio.enums import Resampling
from rasterio.errors import NotGeoreferencedWarning

from tests.oblong import cosine_of, longitude_pixel, rotated, write_geotiff
from tests.skill.imagery.files import geotiff
from vehanchor.errors import ImageTooLargeError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_preview, read_reduced_window
from vehanchor.options import ImageLimits, Reading

UTM = "EPSG:32632"


@pytest.fixture(scope="module")
def noise() -> NDArray[np.uint8]:
    """A smooth picture ``[240, 320, 3]``."""
    coarse = np.random.default_rng(3).integers(0, 255, (15, 20, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC), np.uint8)


@pytest.mark.parametrize(
    ("crs", "transform", "size", "gsd_m_per_px"),
    [
        (UTM, Affine(0.1, 0, 5e5, 0, -0.2, 5e6), (320, 480), 0.1),
        (UTM, Affine(0.2, 0, 5e5, 0, -0.1, 5e6), (640, 240), 0.1),
        (UTM, Affine(0.1, 0, 5e5, 0, 0.2, 5e6), (320, 480), 0.1),
        (UTM, Affine(-0.1, 0, 5e5, 0, -0.2, 5e6), (320, 480), 0.1),
        (UTM, rotated(0.1, 0.2, 30), (320, 480), 0.1),
        (UTM, rotated(0.2, 0.1, 90), (640, 240), 0.1),
        (UTM, rotated(0.2, 0.2, 30), (320, 240), 0.2),
        (UTM, Affine(0.2, 0, 5e5, 0, -0.2, 5e6), (320, 240), 0.2),
        (UTM, Affine(0.2, 0, 5e5, 0, -0.2015, 5e6), (320, 240), 0.2),
        ("EPSG:4326", longitude_pixel(1e-6, 60), (320, 480), None),
        ("EPSG:4326", longitude_pixel(1e-6, -60), (320, 480), None),
        ("EPSG:4326", longitude_pixel(1e-6, 30), (320, 277), None),
        ("EPSG:4326", longitude_pixel(1e-6, 0), (320, 240), None),
        ("EPSG:3857", Affine(0.2, 0, 1e6, 0, -0.2, 6e6), (320, 240), None),
        # Plate carree and an equal-area cylinder, in metres, at 47.1 and 59.7 degrees north.
        ("EPSG:4087", Affine(0.2, 0, 1e6, 0, -0.2, 5.24e6), (320, 352), 0.1363),
        ("EPSG:6933", Affine(0.2, 0, 1e6, 0, -0.2, 6.348e6), (320, 715), 0.1160),
    ],
)
def test_an_image_has_square_pixels_of_the_shorter_side(
    crs: str,
    transform: Affine,
    size: tuple[int, int],
    gsd_m_per_px: float | None,
    noise: NDArray[np.uint8],
    tmp_path: Path,
) -> None:
    path = write_geotiff(tmp_path / "a.tif", noise, crs, transform)
    with open_raster(path) as raster:
        assert (raster.width_px, raster.height_px) == pytest.approx(size, abs=2)
        assert (raster.grid.width_px, raster.grid.height_px) == (320, 240)
        codes = [note.code for note in raster.warnings]
        assert codes == ([] if size == (320, 240) else ["pixels_not_square"])
        if gsd_m_per_px is not None:
            assert raster.georeference_gsd_m_per_px == pytest.approx(gsd_m_per_px, rel=5e-3)


@pytest.fixture
def oblong(noise: NDArray[np.uint8], tmp_path: Path) -> Path:
    """The picture with pixels 1.45 times as high as wide: 320 x 348 square ones."""
    transform = Affine(0.1, 0, 5e5, 0, -0.145, 5e6)
    return write_geotiff(tmp_path / "oblong.tif", noise, UTM, transform)


def test_square_pixels_are_a_resized_image(oblong: Path, noise: NDArray[np.uint8]) -> None:
    expected = cv2.resize(noise, (320, 348), interpolation=cv2.INTER_LINEAR)
    with open_raster(oblong) as raster:
        difference = raster.read().astype(int) - expected
    assert np.abs(difference).max() <= 2


_WINDOWS = (
    Window(0, 0, width_px=50, height_px=40),
    Window(31, 77, width_px=7, height_px=1),
    Window(300, 340, width_px=20, height_px=8),
)


def test_windows_are_parts_of_the_whole_image(oblong: Path) -> None:
    with open_raster(oblong) as raster:
        whole = raster.read()
        for window in _WINDOWS:
            rows = slice(window.y_px, window.y_px + window.height_px)
            columns = slice(window.x_px, window.x_px + window.width_px)
            assert (raster.read(window) == whole[rows, columns]).all()


def test_overviews_have_square_pixels(oblong: Path) -> None:
    with rasterio.open(oblong, "r+") as dataset:
        dataset.build_overviews([2], Resampling.average)
    window = Window(10, 20, width_px=100, height_px=120)
    with open_raster(oblong) as raster:
        assert raster.read_overview(window, 2) is not None
        preview = read_preview(raster, window, 2).astype(int)
        difference = preview - read_reduced_window(raster, window, 2)
    assert np.abs(difference).max() <= 12


def test_the_identity_is_that_of_the_files_pixels(oblong: Path, noise: NDArray[np.uint8]) -> None:
    from vehanchor.imagery.identity import image_id

    with open_raster(oblong) as raster, open_raster(noise) as array:
        assert image_id(raster) == image_id(array)


def test_a_window_of_a_large_image_reads_only_its_part(
    oblong: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_raster(oblong) as raster:
        read: list[Window] = []
        original = raster.in_file.read

        def recorded(window: Window) -> NDArray[np.uint8]:
            read.append(window)
            return original(window)

        monkeypatch.setattr(raster.in_file, "read", recorded)
        raster.read(Window(100, 145, width_px=10, height_px=29))
    assert [(window.width_px, window.height_px) for window in read] == [(10, 22)]


def test_square_pixels_count_against_the_limit(oblong: Path) -> None:
    limits = ImageLimits(max_windowed_pixels=320 * 300)
    with pytest.raises(ImageTooLargeError, match="320 x 348 px"):
        open_raster(oblong, Reading(limits=limits))


@pytest.mark.parametrize(
    "transform", [Affine(1e-6, 1e-6, 11, 1e-6, -1e-6, 60), Affine(1, 0, 5e5, 0, -20, 5e6)]
)
def test_a_skewed_or_absurd_pixel_is_a_doubt(
    transform: Affine, noise: NDArray[np.uint8], tmp_path: Path
) -> None:
    crs = "EPSG:4326" if abs(transform.c) < 180 else UTM
    path = write_geotiff(tmp_path / "a.tif", noise, crs, transform)
    with open_raster(path) as raster:
        assert raster.grid.is_square
        # No single scale holds, so that nothing is measured by that of the file.
        assert raster.georeference_gsd_m_per_px is None
        assert [note.code for note in raster.warnings] == ["stretched"]


@pytest.mark.parametrize(
    ("transform", "aspect"),
    [
        (longitude_pixel(1e-6, 60), 2.0),
        (longitude_pixel(1e-6, -47), 1 / cosine_of(47)),
        (Affine(0.1, 0, 5e5, 0, -0.145, 5e6), 1.45),
        (Affine(0.1, 0, 0, 0, -0.1, 24), 1.0),
        (Affine.identity(), 1.0),
    ],
)
def test_a_transform_without_reference_system_gives_the_shape_of_a_pixel(
    transform: Affine, aspect: float, noise: NDArray[np.uint8], tmp_path: Path
) -> None:
    path = geotiff(tmp_path / "a.tif", noise, crs=None, transform=transform)
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        assert raster.grid.aspect == pytest.approx(aspect, rel=5e-3)


def test_control_points_give_the_shape_of_a_pixel(noise: NDArray[np.uint8], tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", noise, crs=None, transform=None)
    degrees = longitude_pixel(1e-6, 60)
    corners = [(column, row) for column in (0, 320) for row in (0, 240)]
    points = []
    for column, row in corners:
        x, y = degrees @ (column, row)
        points.append(GroundControlPoint(row=row, col=column, x=x, y=y))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        dataset = rasterio.open(path, "r+")
    with dataset:
        dataset.gcps = (points, CRS.from_epsg(4326))
    with open_raster(path) as raster:
        assert raster.georeference_gsd_m_per_px is None
        assert raster.grid.aspect == pytest.approx(2.0, rel=5e-3)


def test_a_degree_of_longitude_is_shorter_by_the_cosine(
    tmp_path: Path, noise: NDArray[np.uint8]
) -> None:
    path = write_geotiff(tmp_path / "a.tif", noise, "EPSG:4326", longitude_pixel(1e-6, 47))
    with open_raster(path) as raster:
        assert raster.pixel_aspect == 1.0
        assert raster.grid.aspect == pytest.approx(1 / cosine_of(47), rel=5e-3)
