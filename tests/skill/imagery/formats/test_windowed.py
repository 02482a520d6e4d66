"""JPEG 2000 is read by windows, and held to its codestream before OpenJPEG sees it."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.transform import Affine

import vehanchor
from tests.skill.imagery.files import NOISE
from vehanchor.errors import ImageDecodeError, ImageError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

SIZE = 8  # where SIZ's sides begin in a codestream


def encoded(pixels: np.ndarray = NOISE, **options: object) -> bytes:
    """``[h, w, bands]`` without loss."""
    height, width, count = pixels.shape
    lossless = {"QUALITY": "100", "REVERSIBLE": "YES", "YCBCR420": "NO"}
    with warnings.catch_warnings(), MemoryFile(ext=".jp2") as file:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        profile = {"width": width, "height": height, "count": count, "dtype": pixels.dtype.name}
        with file.open(driver="JP2OpenJPEG", **profile, **lossless, **options) as dataset:
            dataset.write(pixels.transpose(2, 0, 1))
        return bytes(file.read())


def declaring(data: bytes, **sides: int) -> bytes:
    """The file with other numbers in its codestream."""
    names = ("right", "bottom", "left", "top", "tile_width", "tile_height")
    at = data.index(b"\xff\x4f\xff\x51") + SIZE
    values = dict(zip(names, struct.unpack_from(">6I", data, at), strict=True)) | sides
    return data[:at] + struct.pack(">6I", *values.values()) + data[at + 24 :]


@pytest.fixture(scope="module")
def jp2() -> bytes:
    return encoded()


def test_it_is_read_by_windows_from_a_file_and_from_memory(jp2: bytes, tmp_path: Path) -> None:
    (tmp_path / "photo.jp2").write_bytes(jp2)
    for source in (jp2, tmp_path / "photo.jp2"):
        with open_raster(source) as raster:
            assert np.array_equal(raster.read(), NOISE)
            assert np.array_equal(
                raster.read(Window(20, 30, width_px=50, height_px=40)), NOISE[30:70, 20:70]
            )
    assert vehanchor.find_images(tmp_path) == [str(tmp_path / "photo.jp2")]


def test_a_bare_codestream_is_the_same_picture(jp2: bytes) -> None:
    with open_raster(jp2[jp2.index(b"\xff\x4f\xff\x51") :]) as raster:
        assert np.array_equal(raster.read(), NOISE)


def test_one_of_16_bits_and_of_a_known_place_is_stretched_and_lies_there() -> None:
    pixels = NOISE.astype(np.uint16) * 40
    data = encoded(
        pixels, crs="EPSG:32633", transform=Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000)
    )
    with open_raster(data) as raster:
        assert raster.georeference_gsd_m_per_px == pytest.approx(0.25)
        assert raster.ground is not None
        assert [note.code for note in raster.warnings] == ["pixels_stretched"]
        assert raster.read().std() > 50


def test_sizes_are_those_that_the_decoder_allocates_by(jp2: bytes) -> None:
    header = read_header(lambda at, count: jp2[at : at + count])
    assert (header.format, header.width_px, header.height_px, header.bands) == (
        "JPEG 2000",
        130,
        90,
        3,
    )
    huge = declaring(jp2, right=1 << 20, bottom=1 << 20)
    with pytest.raises(ImageTooLargeError, match="1048576 x 1048576 px"):
        open_raster(huge)
    one_tile = declaring(jp2, right=60_000, bottom=60_000, tile_width=60_000, tile_height=60_000)
    with pytest.raises(ImageTooLargeError, match="stored in blocks of 3600000000 pixels"):
        open_raster(one_tile)
    with pytest.raises(ImageTooLargeError, match="stored in blocks"):
        open_raster(jp2, Reading(limits=ImageLimits(max_pixels=1000)))


def test_a_larger_one_than_may_be_decoded_whole_is_read_by_its_tiles() -> None:
    tiled = encoded(np.tile(NOISE, (5, 5, 1)), BLOCKXSIZE="256", BLOCKYSIZE="256")
    with open_raster(tiled, Reading(limits=ImageLimits(max_pixels=200_000))) as raster:
        assert np.array_equal(raster.read(Window(130, 90, width_px=130, height_px=90)), NOISE)


@pytest.mark.parametrize("kept", [0.01, 0.05, 0.3, 0.7, 0.95])
def test_one_that_was_cut_off_is_refused(jp2: bytes, kept: float) -> None:
    with pytest.raises(ImageDecodeError), open_raster(jp2[: int(kept * len(jp2))]) as raster:
        raster.read()


def test_what_is_damaged_is_an_error_of_ours_or_a_picture(jp2: bytes) -> None:
    generator = np.random.default_rng(5)
    for _ in range(10):
        data = bytearray(jp2)
        for at in generator.integers(0, min(len(data), 400), 3):
            data[at] = generator.integers(256)
        try:
            with open_raster(bytes(data)) as raster:
                assert raster.read().shape == (raster.height_px, raster.width_px, 3)
        except ImageError:
            pass


@pytest.mark.parametrize("sides", [{"right": 0}, {"tile_width": 0}, {"left": 200}])
def test_a_size_without_meaning_is_damage(jp2: bytes, sides: dict[str, int]) -> None:
    with pytest.raises(ImageDecodeError, match=r"declares no size|damaged"):
        open_raster(declaring(jp2, **sides))


def test_boxes_without_end_are_refused(jp2: bytes) -> None:
    start = jp2[:12]
    with pytest.raises(ImageTooLargeError, match="more than 1000 boxes"):
        open_raster(start + (struct.pack(">I", 8) + b"free") * 2000)
    with pytest.raises(ImageDecodeError, match="holds no image"):
        open_raster(start + struct.pack(">I", 0) + b"free" + bytes(100))


def test_without_rasterio_it_is_said_what_to_install(
    jp2: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    with pytest.raises(MissingExtraError, match=r"vehanchor\[geo\]"):
        open_raster(jp2)


def test_a_jpeg_beyond_the_limit_is_refused_with_the_ways_to_read_it() -> None:
    jpeg = cv2.imencode(".jpg", NOISE)[1].tobytes()
    with pytest.raises(ImageTooLargeError, match=r"--max-megapixels.*convert it to a tiled TIFF"):
        open_raster(jpeg, Reading(limits=ImageLimits(max_pixels=10_000)))
