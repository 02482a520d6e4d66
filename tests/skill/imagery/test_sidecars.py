"""Files beside an image: its mask, and its map coordinates."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np
import pytest
from PIL import Image
from rasterio.crs import CRS

from tests.skill.imagery.files import geotiff
from vehanchor.imagery.raster import Raster
from vehanchor.imagery.sources.opening import open_raster

PIXELS = np.random.default_rng(1).integers(40, 200, (80, 100, 3), np.uint8)
MASK = np.full((80, 100), 255, np.uint8)
MASK[:, :50] = 0


def _codes(raster: Raster) -> list[str]:
    return [note.code for note in raster.warnings]


def _write(path: Path) -> Path:
    if path.name.startswith("map"):
        return geotiff(path, PIXELS)
    if path.name.startswith("tiled"):
        return geotiff(path, PIXELS, crs=None, transform=None)
    Image.fromarray(PIXELS).save(path)
    return path


@pytest.mark.parametrize("name", ["plain.tif", "map.tif", "plain.png"])
def test_pixels_outside_the_mask_beside_an_image_are_black(name: str, tmp_path: Path) -> None:
    path = _write(tmp_path / name)
    Image.fromarray(MASK).save(tmp_path / f"{name}.msk", format="TIFF")
    with open_raster(path) as raster:
        pixels = raster.read()
        assert not pixels[:, :50].any()
        assert pixels[:, 50:].min() >= 40
        assert _codes(raster) == []


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.tif")
    Image.fromarray(MASK[:40]).save(tmp_path / "plain.tif.msk", format="TIFF")
    with open_raster(path) as raster:
        assert raster.read().min() >= 40
        assert _codes(raster) == ["sidecar_unused"]


def test_a_damaged_mask_is_named(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.tif")
    (tmp_path / "plain.tif.msk").write_bytes(b"II*\0 no mask")
    with open_raster(path) as raster:
        assert _codes(raster) == ["sidecar_unused"]


WORLD = "0.1\n0\n0\n-0.1\n500000.05\n5199999.95\n"
TRANSFORM = "<GeoTransform> 500000, 0.1, 0, 5200000, 0, -0.1</GeoTransform>"
PAM = "<PAMDataset>{}<Metadata><GeoTransform>1</GeoTransform></Metadata></PAMDataset>"
UTM = CRS.from_epsg(32632)
SYSTEM = f"<SRS>{escape(UTM.to_wkt())}</SRS>"


@pytest.mark.parametrize("name", ["plain.tif", "plain.png", "tiled.tif"])
@pytest.mark.parametrize(
    ("world", "projection", "pam"),
    [
        (WORLD, UTM.to_wkt(), None),
        (WORLD, UTM.to_wkt(version="WKT1_ESRI"), None),
        (WORLD.replace(".", ","), None, SYSTEM),
        (None, None, TRANSFORM + "<SRS>EPSG:32632</SRS>"),
        (None, UTM.to_wkt(), TRANSFORM),
    ],
)
def test_map_coordinates_beside_an_image_georeference_it(
    name: str, world: str | None, projection: str | None, pam: str | None, tmp_path: Path
) -> None:
    path = _write(tmp_path / name)
    _write_sidecars(path, world, projection, pam)
    with open_raster(path) as raster:
        assert _codes(raster) == []
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.1)
        assert raster.ground is not None
        transform = raster.ground.transform
        assert raster.ground.crs.to_epsg() == 32632
    assert tuple(transform)[:6] == pytest.approx((0.1, 0, 500000, 0, -0.1, 5200000))


def _write_sidecars(
    path: Path, world: str | None, projection: str | None, pam: str | None = None
) -> None:
    """Write the files beside an image that are not None."""
    if world is not None:
        path.with_suffix(".wld").write_text(world)
    if projection is not None:
        path.with_suffix(".prj").write_text(projection)
    if pam is not None:
        path.with_name(f"{path.name}.aux.xml").write_text(PAM.format(pam))


def test_coordinates_of_a_turned_photograph_are_those_of_its_stored_pixels(
    tmp_path: Path,
) -> None:
    path = tmp_path / "turned.jpg"
    exif = Image.Exif()
    exif[274] = 6  # the camera stood upright: the stored pixels are turned clockwise
    Image.fromarray(PIXELS).save(path, exif=exif)
    _write_sidecars(path, WORLD, UTM.to_wkt())
    with open_raster(path) as raster:
        assert (raster.width_px, raster.height_px) == (80, 100)
        assert raster.ground is not None
        # The first stored pixel lies at the upper right of the upright picture.
        a, b, c, d, e, f = raster.ground.transform[:6]
    assert (80 * a + c, 80 * d + f) == pytest.approx((500000, 5200000))
    # A stored row runs downwards.
    assert (a, b, d, e) == pytest.approx((0, 0.1, 0.1, 0))


def test_a_degree_beside_an_image_gives_the_shape_of_a_pixel(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.png")
    _write_sidecars(path, "1e-6\n0\n0\n-1e-6\n11\n60\n", CRS.from_epsg(4326).to_wkt())
    with open_raster(path) as raster:
        assert raster.grid.aspect == pytest.approx(2, rel=0.01)


def test_a_world_file_alone_gives_the_shape_of_a_pixel(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.png")
    _write_sidecars(path, "1e-6\n0\n0\n-1e-6\n11\n60\n", None)
    with open_raster(path) as raster:
        assert raster.grid.aspect == pytest.approx(2, rel=0.01)
        assert _codes(raster) == ["sidecar_unused", "pixels_not_square"]


def test_a_georeferenced_file_keeps_its_own_coordinates(tmp_path: Path) -> None:
    path = _write(tmp_path / "map.tif")
    with open_raster(path) as raster:
        before = raster.ground
    _write_sidecars(path, WORLD, UTM.to_wkt())
    with open_raster(path) as raster:
        assert raster.ground == before


def test_statistics_beside_an_image_are_no_news(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.png")
    _write_sidecars(path, None, None, "<PAMRasterBand band='1'/>")
    with open_raster(path) as raster:
        assert _codes(raster) == []


LOCAL_GRID = UTM.to_wkt()[:-1] + ',EXTENSION["PROJ4","+proj=utm +nadgrids=/etc/passwd"]]'


@pytest.mark.parametrize(
    ("world", "projection", "pam", "reason"),
    [
        (WORLD, None, None, "plain.wld: no reference system is stated"),
        ("1 2 3", UTM.to_wkt(), None, "plain.wld: it does not have six numbers"),
        ("1 0 0 nan 0 0", UTM.to_wkt(), None, "plain.wld: it does not have six numbers"),
        ("0 0 0 0 0 0", UTM.to_wkt(), None, "plain.wld: its transform has no inverse"),
        (5000 * " ", UTM.to_wkt(), None, "plain.wld: it has more than 4096 bytes"),
        (WORLD, "+proj=utm +zone=32", None, "neither WKT nor an EPSG code"),
        (WORLD, "/etc/passwd", None, "neither WKT nor an EPSG code"),
        (WORLD, "PROJCS[damaged", None, "its reference system is unknown"),
        (WORLD, LOCAL_GRID, None, "its reference system names another file"),
        (WORLD, None, "<SRS>EPSG:9", "plain.png.aux.xml: it is not XML"),
        (WORLD, CRS.from_epsg(4326).to_wkt(), None, "not those of the stated reference system"),
    ],
)
def test_unusable_coordinates_are_named(
    world: str, projection: str | None, pam: str | None, reason: str, tmp_path: Path
) -> None:
    path = _write(tmp_path / "plain.png")
    _write_sidecars(path, world, projection, pam)
    with open_raster(path) as raster:
        assert raster.ground is None
        assert raster.georeference_gsd_m_per_px is None
        (note,) = raster.warnings
    assert note.code == "sidecar_unused"
    assert reason in note.message


def test_gdal_writes_nothing_of_a_damaged_reference_system(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = _write(tmp_path / "plain.png")
    _write_sidecars(path, WORLD, 'GEOGCS["secret",DATUM["b"', None)
    with open_raster(path):
        pass
    assert capfd.readouterr().err == ""


@pytest.mark.promise("sidecars")
def test_entities_beside_an_image_are_refused(tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.png")
    pam = path.with_name("plain.png.aux.xml")
    pam.write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]>' + PAM.format(TRANSFORM))
    with open_raster(path) as raster:
        (note,) = raster.warnings
    assert "declares a document type" in note.message


def test_masked_pixels_of_an_array_are_black() -> None:
    is_masked = np.repeat((MASK == 0)[:, :, None], 3, axis=2)
    with open_raster(np.ma.masked_array(PIXELS, is_masked)) as raster:
        pixels = raster.read()
    assert not pixels[:, :50].any()
    np.testing.assert_array_equal(pixels[:, 50:], PIXELS[:, 50:])


def test_another_page_of_a_tiff_is_named(tmp_path: Path) -> None:
    path = tmp_path / "pages.tif"
    large = Image.fromarray(cv2.resize(PIXELS, None, fx=3, fy=3))
    Image.fromarray(PIXELS).save(path, save_all=True, append_images=[large])
    with open_raster(path) as raster:
        assert _codes(raster) == ["pages_unused"]
        assert "300 x 240 px" in raster.warnings[0].message


@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_further_pictures_of_an_animation_are_named(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"animated.{suffix}"
    others = [Image.fromarray(255 - PIXELS)]
    Image.fromarray(PIXELS).save(path, save_all=True, append_images=others, lossless=True)
    with open_raster(path) as raster:
        np.testing.assert_array_equal(raster.read(), PIXELS)
        assert _codes(raster) == ["pages_unused"]
