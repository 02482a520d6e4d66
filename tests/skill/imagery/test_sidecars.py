"""Files beside an image: its mask, and map coordinates that are not used."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

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


@pytest.mark.parametrize("beside", ["plain.tfw", "plain.wld", "plain.tif.aux.xml"])
def test_a_file_with_map_coordinates_is_named(beside: str, tmp_path: Path) -> None:
    path = _write(tmp_path / "plain.tif")
    (tmp_path / beside).write_text("0.1\n0\n0\n-0.1\n0\n0\n")
    with open_raster(path) as raster:
        (note,) = raster.warnings
        assert note.code == "sidecar_unused"
        assert beside in note.message


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
