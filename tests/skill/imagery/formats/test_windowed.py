"""JPEG 2000 is read by windows, after its codestream has been checked."""

from __future__ import annotations

import contextlib
import struct
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.transform import Affine

import vehanchor
from tests.skill.imagery.files import NOISE, header_of
from vehanchor.errors import ImageDecodeError, ImageError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

CODESTREAM = b"\xff\x4f\xff\x51"
SIDES_OFFSET = 8
"""Bytes of a codestream before its sides."""

SIDES = ("right", "bottom", "left", "top", "tile_width", "tile_height")


def encoded(pixels: np.ndarray = NOISE, **options: object) -> bytes:
    """Encode ``[h, w, bands]`` without loss."""
    height, width, count = pixels.shape
    lossless = {"QUALITY": "100", "REVERSIBLE": "YES", "YCBCR420": "NO"}
    with warnings.catch_warnings(), MemoryFile(ext=".jp2") as file:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        profile = {"width": width, "height": height, "count": count, "dtype": pixels.dtype.name}
        with file.open(driver="JP2OpenJPEG", **profile, **lossless, **options) as dataset:
            dataset.write(pixels.transpose(2, 0, 1))
        return bytes(file.read())


def declaring(data: bytes, **sides: int) -> bytes:
    """Declare other sides in the codestream."""
    start = data.index(CODESTREAM) + SIDES_OFFSET
    values = dict(zip(SIDES, struct.unpack_from(">6I", data, start), strict=True))
    values |= sides
    return data[:start] + struct.pack(">6I", *values.values()) + data[start + 24 :]


@pytest.fixture(scope="module")
def jp2() -> bytes:
    return encoded()


@pytest.fixture
def jp2_path(jp2: bytes, tmp_path: Path) -> Path:
    path = tmp_path / "photo.jp2"
    path.write_bytes(jp2)
    return path


@pytest.mark.parametrize("read", [Path, Path.read_bytes])
def test_it_is_read_by_windows(read: Callable[[Path], Any], jp2_path: Path) -> None:
    with open_raster(read(jp2_path)) as raster:
        whole = raster.read()
        part = raster.read(Window(20, 30, width_px=50, height_px=40))
    assert np.array_equal(whole, NOISE)
    assert np.array_equal(part, NOISE[30:70, 20:70])


def test_it_is_listed_among_the_images_of_a_folder(jp2_path: Path) -> None:
    assert vehanchor.find_images(jp2_path.parent) == [str(jp2_path)]


def test_a_bare_codestream_is_the_same_picture(jp2: bytes) -> None:
    with open_raster(jp2[jp2.index(CODESTREAM) :]) as raster:
        assert np.array_equal(raster.read(), NOISE)


@pytest.fixture(scope="module")
def deep_jp2() -> bytes:
    """Encode an image of 16 bits with a georeference."""
    pixels = NOISE.astype(np.uint16) * 40
    transform = Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000)
    return encoded(pixels, crs="EPSG:32633", transform=transform)


def test_its_georeference_is_read(deep_jp2: bytes) -> None:
    with open_raster(deep_jp2) as raster:
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
        assert raster.ground is not None


def test_sixteen_bits_are_stretched(deep_jp2: bytes) -> None:
    with open_raster(deep_jp2) as raster:
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
        assert raster.read().std() > 50


def test_its_header_has_the_sizes_of_the_codestream(jp2: bytes) -> None:
    header = header_of(jp2)
    assert header.format == "JPEG 2000"
    assert (header.width_px, header.height_px, header.bands) == (130, 90, 3)


def test_a_huge_codestream_is_refused(jp2: bytes) -> None:
    huge = declaring(jp2, right=1 << 20, bottom=1 << 20)
    with pytest.raises(ImageTooLargeError, match="1048576 x 1048576 px"):
        open_raster(huge)


def test_a_huge_tile_is_refused(jp2: bytes) -> None:
    one_tile = declaring(jp2, right=60_000, bottom=60_000, tile_width=60_000, tile_height=60_000)
    with pytest.raises(ImageTooLargeError, match="stored in blocks of 3600000000 pixels"):
        open_raster(one_tile)


def test_a_tile_is_held_to_the_limit_on_pixels(jp2: bytes) -> None:
    with pytest.raises(ImageTooLargeError, match="stored in blocks"):
        open_raster(jp2, Reading(limits=ImageLimits(max_pixels=1000)))


def test_one_too_large_to_decode_whole_is_read_by_its_tiles() -> None:
    tiled = encoded(np.tile(NOISE, (5, 5, 1)), BLOCKXSIZE="256", BLOCKYSIZE="256")
    with open_raster(tiled, Reading(limits=ImageLimits(max_pixels=200_000))) as raster:
        assert np.array_equal(raster.read(Window(130, 90, width_px=130, height_px=90)), NOISE)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.3, 0.7, 0.95])
def test_a_file_that_is_cut_off_is_refused(jp2: bytes, share: float) -> None:
    data = jp2[: int(share * len(jp2))]
    with pytest.raises(ImageDecodeError), open_raster(data) as raster:
        raster.read()


def test_a_damaged_file_is_refused_or_read(jp2: bytes) -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        damaged = bytearray(jp2)
        for position in rng.integers(0, min(len(damaged), 400), 3):
            damaged[position] = rng.integers(256)
        with contextlib.suppress(ImageError), open_raster(bytes(damaged)) as raster:
            assert raster.read().shape == (raster.height_px, raster.width_px, 3)


@pytest.mark.parametrize("sides", [{"right": 0}, {"tile_width": 0}, {"left": 200}])
def test_an_invalid_size_is_damage(jp2: bytes, sides: dict[str, int]) -> None:
    with pytest.raises(ImageDecodeError, match=r"declares no size|damaged"):
        open_raster(declaring(jp2, **sides))


def test_too_many_boxes_are_refused(jp2: bytes) -> None:
    crowd = (struct.pack(">I", 8) + b"free") * 2000
    with pytest.raises(ImageTooLargeError, match="more than 1000 boxes"):
        open_raster(jp2[:12] + crowd)


def test_a_file_without_a_codestream_is_refused(jp2: bytes) -> None:
    box_to_the_end = struct.pack(">I", 0) + b"free" + bytes(100)
    with pytest.raises(ImageDecodeError, match="holds no image"):
        open_raster(jp2[:12] + box_to_the_end)


def test_without_rasterio_the_error_names_the_extra(
    jp2: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MissingExtraError, match=r"pip install '\.\[geo\]'"):
        open_raster(jp2)


def test_a_jpeg_beyond_the_limit_is_refused_with_remedies() -> None:
    jpeg = cv2.imencode(".jpg", NOISE)[1].tobytes()
    with pytest.raises(ImageTooLargeError, match=r"--max-megapixels.*convert it to a tiled TIFF"):
        open_raster(jpeg, Reading(limits=ImageLimits(max_pixels=10_000)))
