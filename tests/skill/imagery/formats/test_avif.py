"""AVIF is read as other formats are: upright, and whole or not at all.

Too large an image is refused by its declared sizes, before decoding.
"""

from __future__ import annotations

import contextlib
import io
import struct

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from tests.skill.imagery.files import header_of
from vehanchor.errors import ImageDecodeError, ImageError, ImageTooLargeError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

HEIGHT = 96
WIDTH = 128


def encoded(height: int = HEIGHT, width: int = WIDTH, orientation: int | None = None) -> bytes:
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 3, : width // 3] = 255
    picture[height // 2 :, :, 1] = 200
    exif = Image.Exif()
    if orientation is not None:
        exif[274] = orientation
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "AVIF", quality=95, exif=exif)
    return file.getvalue()


def declaring(data: bytes, width: int, height: int) -> bytes:
    """Declare another size in the container; that in AV1 stays."""
    start = data.index(b"ispe") + 8
    return data[:start] + struct.pack(">II", width, height) + data[start + 8 :]


def read(data: bytes, limits: ImageLimits | None = None) -> np.ndarray:
    with open_raster(data, Reading(limits=limits or ImageLimits())) as raster:
        return raster.read()


def test_its_camera_metadata_are_read() -> None:
    exif = Image.Exif()
    exif[0x010F] = "DJI"
    exif.get_ifd(0x8769)[0xA405] = 24
    file = io.BytesIO()
    Image.new("RGB", (WIDTH, HEIGHT)).save(file, "AVIF", exif=exif)
    with open_raster(file.getvalue()) as raster:
        assert raster.camera is not None
        assert raster.camera.focal_35mm == 24.0


@pytest.mark.parametrize("orientation", range(1, 9))
def test_it_is_turned_upright(orientation: int) -> None:
    data = encoded(orientation=orientation)
    image = Image.open(io.BytesIO(data))
    upright = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    pixels = read(data)
    assert pixels.shape == upright.shape
    assert np.abs(pixels.astype(int) - upright).max() <= 3, "two decoders' rounding"


@pytest.mark.parametrize("bands", [3, 4])
def test_opencvs_own_files_are_read(bands: int) -> None:
    _, data = cv2.imencode(".avif", np.full((HEIGHT, WIDTH, bands), 200, np.uint8))
    assert read(data.tobytes()).shape == (HEIGHT, WIDTH, 3)


@pytest.fixture
def no_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))


@pytest.mark.usefixtures("no_decoding")
@pytest.mark.parametrize("size", [(40_000, 40_000), (0xFFFFFFFF, 0xFFFFFFFF), (4, 1_000_000_000)])
def test_a_huge_declared_size_is_refused_before_decoding(size: tuple[int, int]) -> None:
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        read(declaring(encoded(), *size))


@pytest.mark.usefixtures("no_decoding")
def test_a_large_image_with_a_small_declared_size_is_refused() -> None:
    hidden = declaring(encoded(1000, 1000), 64, 64)
    message = "decoding the AVIF of 64 x 64 px takes 19000000 bytes"
    with pytest.raises(ImageTooLargeError, match=message):
        read(hidden, ImageLimits(max_decoded_bytes=18_000_000))


@pytest.fixture(scope="module")
def ten_bits() -> bytes:
    pixels = np.full((HEIGHT, WIDTH, 3), 700, np.uint16)
    _, data = cv2.imencode(".avif", pixels, [cv2.IMWRITE_AVIF_DEPTH, 10])
    return data.tobytes()


def test_ten_bits_are_read(ten_bits: bytes) -> None:
    assert read(ten_bits).shape == (HEIGHT, WIDTH, 3)


def test_ten_bits_take_more_memory(ten_bits: bytes) -> None:
    assert header_of(ten_bits).decoding_bytes == 25 * HEIGHT * WIDTH


def test_a_picture_has_the_size_that_its_container_declares() -> None:
    assert read(declaring(encoded(), 64, 64)).shape == (64, 64, 3), "the decoder resizes it"


def test_a_file_that_is_cut_off_is_refused() -> None:
    data = encoded(orientation=6)
    for length in range(len(data)):
        with pytest.raises(ImageError):
            read(data[:length])


def test_a_damaged_file_is_refused_or_read_whole() -> None:
    data = encoded(orientation=6)
    rng = np.random.default_rng(1)
    for _ in range(300):
        damaged = bytearray(data)
        damaged[int(rng.integers(12, 330))] = int(rng.integers(256))
        with contextlib.suppress(ImageError):
            assert read(bytes(damaged)).shape[2] == 3


def test_too_many_boxes_are_refused() -> None:
    crowd = encoded()[:32] + struct.pack(">I4s", 8, b"free") * 100_000
    with pytest.raises(ImageTooLargeError, match="more than 1000 boxes"):
        header_of(crowd)


def test_a_box_without_length_ends_the_file() -> None:
    endless = encoded()[:32] + struct.pack(">I4sQ", 1, b"free", 0)
    with pytest.raises(ImageDecodeError, match="no 'meta' box"):
        header_of(endless)


def test_an_opencv_without_avif_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    with pytest.raises(ImageDecodeError, match="pip install -U opencv-python-headless"):
        read(encoded())
