"""Shape of a pixel by the density in a header."""

from __future__ import annotations

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from tests.skill.imagery.files import EXIF_PREFIX, after_start, encoded, exif, segment
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.scale.reliability import STRETCHED_SHARE, chance_of_stretch, log_odds_by_density

_IMAGE = np.full((40, 60, 3), 120, np.uint8)
_PNG_HEADER_BYTES = 33


def _jpeg(across: int, down: int) -> bytes:
    data = bytearray(cv2.imencode(".jpg", _IMAGE)[1].tobytes())
    assert data[6:11] == b"JFIF\0"
    struct.pack_into(">HH", data, 14, across, down)
    return bytes(data)


def _png(across: int, down: int) -> bytes:
    data = cv2.imencode(".png", _IMAGE)[1].tobytes()
    content = b"pHYs" + struct.pack(">IIB", across, down, 1)
    chunk = struct.pack(">I", 9) + content + struct.pack(">I", zlib.crc32(content))
    return data[:_PNG_HEADER_BYTES] + chunk + data[_PNG_HEADER_BYTES:]


def _with_tags(file_format: str, across: int, down: int, orientation: int = 1) -> bytes:
    """Encode an image with densities as EXIF or TIFF tags."""
    exif = Image.Exif()
    exif[274] = orientation
    exif[282] = IFDRational(across)
    exif[283] = IFDRational(down)
    file = io.BytesIO()
    if file_format == "TIFF":
        Image.fromarray(_IMAGE).save(file, "TIFF", dpi=(across, down))
    else:
        Image.fromarray(_IMAGE).save(file, file_format, exif=exif)
    return file.getvalue()


def _of_original(width_px: int, height_px: int) -> bytes:
    """Encode an image with the size of its original in EXIF."""
    size = {"PixelXDimension": width_px, "PixelYDimension": height_px}
    return after_start(encoded(".jpg", _IMAGE), segment(EXIF_PREFIX + exif(size)))


@pytest.mark.parametrize(
    ("data", "aspect"),
    [
        (_jpeg(72, 72), 1.0),
        (_jpeg(108, 72), 1.5),
        (_jpeg(0, 72), 1.0),
        (_jpeg(65000, 1), 1.0),
        (_png(2835, 5670), 0.5),
        (_with_tags("JPEG", 108, 72), 1.5),
        (_with_tags("JPEG", 108, 72, orientation=6), 1 / 1.5),
        (_with_tags("WEBP", 72, 108), 1 / 1.5),
        (_with_tags("TIFF", 144, 72), 2.0),
        (_with_tags("TIFF", 72, 72), 1.0),
        (_of_original(600, 400), 1.0),
        (_of_original(601, 400), 1.0),
        (_of_original(400, 600), 1.0),
        (_of_original(600, 600), 1.5),
        (_of_original(0, 400), 1.0),
    ],
)
def test_a_density_gives_a_hint_but_no_square_pixels(data: bytes, aspect: float) -> None:
    with open_raster(data) as raster:
        assert raster.density_aspect == pytest.approx(aspect)
        assert raster.grid.is_square


def test_an_oblong_density_raises_the_chance_of_a_stretch() -> None:
    assert log_odds_by_density(1.05) == 0
    for aspect in (1.5, 1 / 1.5):
        assert chance_of_stretch(log_odds_by_density(aspect)) > 10 * STRETCHED_SHARE
