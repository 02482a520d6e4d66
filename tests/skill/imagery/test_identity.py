from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.skill.imagery.files import encoded, geotiff
from vehanchor.imagery import identity
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.sources.opening import ImageSource, open_raster
from vehanchor.options import ImageLimits

WINDOWED = ImageLimits(max_pixels=1_000_000)
SIDE_PX, UNREAD_PX = 4800, 560  # a window of 512 px every 600 px


def _id(source: ImageSource, limits: ImageLimits | None = None) -> str:
    with open_raster(source, limits=limits) as raster:
        return image_id(raster)


def _pair(tmp_path: Path) -> list[Path]:
    """Two tiled TIFFs of equal size that differ in a pixel between the windows."""
    pixels = np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8)
    first = geotiff(tmp_path / "first.tif", pixels, tiled=True, blockxsize=256, blockysize=256)
    pixels[UNREAD_PX, UNREAD_PX] = 91
    second = geotiff(tmp_path / "second.tif", pixels, tiled=True, blockxsize=256, blockysize=256)
    assert first.stat().st_size == second.stat().st_size
    return [first, second]


def test_two_large_images_that_differ_in_one_pixel_have_two_ids(tmp_path: Path) -> None:
    first, second = _pair(tmp_path)
    assert _id(first, WINDOWED) != _id(second, WINDOWED)
    assert _id(first, WINDOWED) == _id(first.read_bytes(), WINDOWED)
    array = np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8)
    other = array.copy()
    other[UNREAD_PX, UNREAD_PX] = 91
    assert _id(array) != _id(other)


def test_the_blocks_of_a_huge_file_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = _pair(tmp_path)
    monkeypatch.setattr(identity, "_BLOCK_BYTES", 1 << 10)
    assert len(identity._blocks(first.stat().st_size)) <= identity._BLOCKS
    assert len(identity._blocks(1 << 40)) == identity._BLOCKS
    assert _id(first, WINDOWED) == _id(first, WINDOWED)
    assert second.exists()


def test_a_path_its_bytes_and_its_array_have_one_id(tmp_path: Path) -> None:
    pixels = np.random.default_rng(3).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    path = tmp_path / "a.png"
    path.write_bytes(encoded(".png", pixels))
    assert _id(path) == _id(path.read_bytes()) == _id(pixels)
    assert _id(pixels) != _id(pixels[:, ::-1])
