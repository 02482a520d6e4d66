from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from vehanchor.errors import ImageDecodeError, ImageTooLargeError, OutOfMemoryError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "P", "CMYK", "1"])
def test_an_image_of_pillow_is_read_in_every_mode(mode: str) -> None:
    image = Image.fromarray(PIXELS).convert(mode)
    read = open_raster(image).read()
    assert np.abs(read.astype(int) - np.asarray(image.convert("RGB"))).max() <= 1


def test_it_is_turned_as_its_file_would_be(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PIXELS).save(tmp_path / "turned.png", exif=exif)
    with Image.open(tmp_path / "turned.png") as image:
        assert (open_raster(image).read() == open_raster(tmp_path / "turned.png").read()).all()


def test_a_truncated_one_and_one_that_is_too_large_are_refused_by_their_codes() -> None:
    encoded = BytesIO()
    Image.fromarray(PIXELS).save(encoded, "PNG")
    with pytest.raises(ImageDecodeError, match="Pillow"):
        open_raster(Image.open(BytesIO(encoded.getvalue()[:2000])))
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        open_raster(Image.fromarray(PIXELS), limits=ImageLimits(max_pixels=2000))


def test_the_memory_that_it_takes_is_limited_by_its_mode_and_told_by_its_code(monkeypatch: pytest.MonkeyPatch) -> None:
    for mode, n_bytes in (("L", 3), ("RGB", 10), ("RGBA", 12), ("F", 12), ("CMYK", 10)):
        image = Image.fromarray(PIXELS).convert(mode)
        open_raster(image, limits=ImageLimits(max_decoded_bytes=2400 * n_bytes))
        with pytest.raises(ImageTooLargeError, match=f"takes {2400 * n_bytes} bytes"):
            open_raster(image, limits=ImageLimits(max_decoded_bytes=2400 * n_bytes - 1))

    def fail(self: Image.Image) -> None:
        raise MemoryError

    monkeypatch.setattr(Image.Image, "getexif", fail)
    with pytest.raises(OutOfMemoryError):
        open_raster(Image.fromarray(PIXELS))


def test_an_array_of_opencv_is_read_as_bgr_where_that_is_said() -> None:
    assert (open_raster(PIXELS[:, :, ::-1], bgr=True).read() == PIXELS).all()


def test_megapixels_are_a_limit_of_pixels_and_of_memory() -> None:
    assert Reading(max_megapixels=0.002).limits.max_pixels == 2000
    large = Reading(max_megapixels=500).limits
    assert (large.max_pixels, large.max_decoded_bytes) == (500_000_000, 5_000_000_000)


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (b"GIF89a" + bytes(40), "a GIF has at most 256 colours"),
        (b"%PDF-1.7" + bytes(40), "pdfimages"),
        (b"\0\0\0\x18ftyphevc" + bytes(40), "a HEIC sequence; save one image"),
        (b"\0\0\0\x18ftypmif1" + bytes(40), "neither AVIF nor HEIC; convert"),
        (b"\0\0\0\x18ftypavis" + bytes(40), "an animation; save one frame"),
        (b"\0\0\0\x18ftypisom" + bytes(40), "a video; save a frame"),
        (b"RIFF\0\0\0\0AVI LIST" + bytes(40), "a video; save a frame"),
        (b"\x1aE\xdf\xa3" + bytes(40), "a video; save a frame"),
        (b"what is this" + bytes(40), "it starts with b'what is '"),
    ],
)
def test_what_is_no_image_of_ours_is_named_with_what_to_do(start: bytes, words: str) -> None:
    with pytest.raises(ImageDecodeError, match=words.replace("'", ".")):
        open_raster(start)
