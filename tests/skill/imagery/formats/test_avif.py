"""AVIF is read as other formats are: upright, whole or not at all, refused by its declared sizes before decoding."""

from __future__ import annotations

import io
import struct
from itertools import chain

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from vehanchor.errors import ImageDecodeError, ImageError, ImageTooLargeError
from vehanchor.imagery.formats.header import read_header
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
    """The file with another size in its container; what AV1 says of itself stays."""
    at = data.index(b"ispe") + 8
    return data[:at] + struct.pack(">II", width, height) + data[at + 8 :]


def read(data: bytes, limits: ImageLimits | None = None) -> np.ndarray:
    with open_raster(data, Reading(limits=limits or ImageLimits())) as raster:
        return raster.read()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_it_is_turned_upright(orientation: int) -> None:
    data = encoded(orientation=orientation)
    upright = np.asarray(ImageOps.exif_transpose(Image.open(io.BytesIO(data))).convert("RGB"))
    shown = read(data)
    assert shown.shape == upright.shape
    assert np.abs(shown.astype(int) - upright).max() <= 3, "two decoders' rounding"


def test_opencvs_own_are_read_with_transparency_too() -> None:
    for bands in (3, 4):
        _, data = cv2.imencode(".avif", np.full((HEIGHT, WIDTH, bands), 200, np.uint8))
        assert read(data.tobytes()).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("size", [(40_000, 40_000), (0xFFFFFFFF, 0xFFFFFFFF), (4, 1_000_000_000)])
def test_a_huge_declared_size_is_refused_before_decoding(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        read(declaring(encoded(), *size))


def test_a_large_picture_behind_a_small_declaration_is_refused_before_decoding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    hidden = declaring(encoded(1000, 1000), 64, 64)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(
        ImageTooLargeError, match="decoding the AVIF of 64 x 64 px takes 19000000 bytes"
    ):
        read(hidden, ImageLimits(max_decoded_bytes=18_000_000))


def test_ten_bits_are_read_and_counted() -> None:
    _, data = cv2.imencode(
        ".avif", np.full((HEIGHT, WIDTH, 3), 700, np.uint16), [cv2.IMWRITE_AVIF_DEPTH, 10]
    )
    header = read_header(lambda offset, count: data.tobytes()[offset : offset + count])
    assert header.decoding_bytes == 25 * HEIGHT * WIDTH
    assert read(data.tobytes()).shape == (HEIGHT, WIDTH, 3)


def test_a_picture_of_another_size_than_declared_is_shown_at_the_declared_one() -> None:
    assert read(declaring(encoded(), 64, 64)).shape == (64, 64, 3), "the decoder resizes it"


def test_wherever_it_is_cut_or_damaged_it_is_refused_or_read_whole() -> None:
    data = encoded(orientation=6)
    rng = np.random.default_rng(1)
    damaged = []
    for _ in range(300):
        broken = bytearray(data)
        broken[int(rng.integers(12, 330))] = int(rng.integers(256))
        damaged.append(bytes(broken))
    for each in chain((data[:length] for length in range(len(data))), damaged):
        try:
            shown = read(each)
        except ImageError:
            continue
        assert len(each) == len(data), "a file that is cut off is never read"
        assert shown.shape[2] == 3


def test_loops_and_crowds_of_boxes_end() -> None:
    crowd = encoded()[:32] + struct.pack(">I4s", 8, b"free") * 100_000
    with pytest.raises(ImageTooLargeError, match="more than 1000 boxes"):
        read_header(lambda offset, count: crowd[offset : offset + count])
    endless = encoded()[:32] + struct.pack(">I4sQ", 1, b"free", 0)
    with pytest.raises(ImageDecodeError, match="no 'meta' box"):
        read_header(lambda offset, count: endless[offset : offset + count])


def test_an_opencv_without_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: None)
    with pytest.raises(ImageDecodeError, match="pip install -U opencv-python-headless"):
        read(encoded())
