from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.skill.imagery.files import encoded, geotiff
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.sources.opening import ImageSource, open_raster
from vehanchor.options import ImageLimits, Reading

READ_WHOLE = Reading()
WINDOWED = Reading(limits=ImageLimits(max_pixels=1_000_000))

# Along the longer side, the checksum covers a window of 512 px every 600 px.
SIDE_PX = 4800
UNREAD_PX = 560
LARGE = np.full((512, SIDE_PX, 3), 90, np.uint8)
LARGE_OTHER = LARGE.copy()
LARGE_OTHER[100, UNREAD_PX] = 91


def _id(source: ImageSource, reading: Reading = READ_WHOLE) -> str:
    with open_raster(source, reading) as raster:
        return image_id(raster)


def _tiled(path: Path, pixels: NDArray[np.uint8]) -> Path:
    return geotiff(path, pixels, tiled=True, blockxsize=256, blockysize=256)


@pytest.fixture(scope="module")
def large_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two files of the same size that differ in one pixel."""
    folder = tmp_path_factory.mktemp("large")
    first = _tiled(folder / "first.tif", LARGE)
    second = _tiled(folder / "second.tif", LARGE_OTHER)
    assert first.stat().st_size == second.stat().st_size
    return first, second


def test_one_pixel_between_the_windows_changes_the_id(large_files: tuple[Path, Path]) -> None:
    first, second = large_files
    assert _id(first, WINDOWED) != _id(second, WINDOWED)


def test_a_large_file_has_the_id_of_its_bytes(large_files: tuple[Path, Path]) -> None:
    first, _ = large_files
    assert _id(first, WINDOWED) == _id(first.read_bytes(), WINDOWED)


def test_one_pixel_of_a_large_array_changes_the_id() -> None:
    assert _id(LARGE) != _id(LARGE_OTHER)


PIXELS = np.random.default_rng(3).integers(0, 255, (300, 400, 3), dtype=np.uint8)


def test_a_path_has_the_id_of_its_bytes_or_array(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(encoded(".png", PIXELS))
    assert _id(path) == _id(path.read_bytes()) == _id(PIXELS)


def test_a_mirrored_image_has_another_id() -> None:
    assert _id(PIXELS) != _id(PIXELS[:, ::-1])
