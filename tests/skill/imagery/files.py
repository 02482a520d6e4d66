"""Images as files, whole, turned, damaged, or nothing but a header; and as arrays."""

from __future__ import annotations

import io
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from vehanchor.imagery.sources.opening import open_raster

WIDTH_PX, HEIGHT_PX = 60, 40


def smooth_rgb(width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX) -> NDArray[np.uint8]:
    """A colour ramp that no flip, turn or band swap leaves as it is, gentle enough for JPEG."""
    x = np.linspace(0, 1, width_px)[np.newaxis, :]
    y = np.linspace(0, 1, height_px)[:, np.newaxis]
    bands = [40 + 180 * x + 0 * y, 200 - 150 * y + 0 * x, 60 + 60 * x * y]
    return np.rint(np.stack(bands, axis=-1)).astype(np.uint8)


RGB = smooth_rgb()

NOISE = np.random.default_rng(7).integers(0, 256, (90, 130, 3), dtype=np.uint8)


def encoded(suffix: str, rgb: NDArray[Any] = RGB, *parameters: int) -> bytes:
    done, data = cv2.imencode(suffix, rgb[..., ::-1] if rgb.ndim == 3 else rgb, parameters)
    assert done
    return data.tobytes()


def pillow(format_name: str, mode: str, rgb: NDArray[Any] = RGB, **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgb).convert(mode).save(buffer, format_name, **options)
    return buffer.getvalue()


def geotiff(path: Path, bands_hwc: NDArray[Any], mask: NDArray[Any] | None = None, **profile: Any) -> Path:
    """Write [h, w, bands] as a GeoTIFF of 0.25 m/px in UTM 31N unless told otherwise."""
    height, width, count = bands_hwc.shape
    profile = {
        "crs": "EPSG:32631",
        "transform": Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000),
        "driver": "GTiff",
        "dtype": bands_hwc.dtype,
        **profile,
    }
    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", width=width, height=height, count=count, **profile) as dataset:
            dataset.write(np.moveaxis(bands_hwc, -1, 0))
            if mask is not None:
                dataset.write_mask(mask)
    return path


def read_all(image: Any, **options: Any) -> NDArray[np.uint8]:
    with open_raster(image, **options) as raster:
        pixels = raster.read()
        assert pixels.shape == (raster.height_px, raster.width_px, 3)
        assert pixels.dtype == np.uint8
        assert pixels.flags.c_contiguous
        return pixels


def exif(orientation: int, order: str = "<") -> bytes:
    mark = b"II*\0" if order == "<" else b"MM\0*"
    return mark + struct.pack(order + "IHHHIHHI", 8, 1, 274, 3, 1, orientation, 0, 0)


def jpeg_with(orientation: int, order: str = "<") -> bytes:
    data = encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 100)
    payload = b"Exif\0\0" + exif(orientation, order)
    comment = b"\xff\xfe\x00\x04hi"
    return data[:2] + comment + b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload + data[2:]


def png_with(orientation: int) -> bytes:
    data = encoded(".png")
    payload = exif(orientation)
    chunk = struct.pack(">I", len(payload)) + b"eXIf" + payload + struct.pack(">I", zlib.crc32(b"eXIf" + payload))
    return data[:33] + chunk + data[33:]


def webp_with(orientation: int) -> bytes:
    return pillow("WEBP", "RGB", lossless=True, exif=b"Exif\0\0" + exif(orientation))


def tiff_with(orientation: int) -> bytes:
    return pillow("TIFF", "RGB", tiffinfo={274: orientation})


@contextmanager
def without_rasterio() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in sys.modules if name.partition(".")[0] == "rasterio"]:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "rasterio", None)
        yield


def png_header(width: int, height: int) -> bytes:
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))


def jpeg_header(width: int, height: int) -> bytes:
    return b"\xff\xd8\xff\xff\xc0" + struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9) + b"\xff\xd9"


def bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHH", 54, 0, 54, 40, width, height, 1, 24) + bytes(24)


def os2_bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIHHHH", 26, 0, 26, 12, width, height, 1, 24)


def webp(chunk: bytes, body: bytes) -> bytes:
    return b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBP" + chunk + struct.pack("<I", len(body)) + body


def webp_header(width: int, height: int) -> bytes:
    return webp(b"VP8X", bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little"))


def webp_lossy_header(width: int, height: int) -> bytes:
    return webp(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height))


def webp_lossless_header(width: int, height: int) -> bytes:
    return webp(b"VP8L", b"\x2f" + struct.pack("<I", (width - 1) | (height - 1) << 14) + b"\0")


def tiff_header(width: int, height: int, order: str = "<") -> bytes:
    entries = [(256, 4, width), (257, 4, height), (258, 3, 8), (262, 3, 1), (277, 3, 1)]
    data = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, value in entries:
        data += struct.pack(order + ("HHIHxx" if kind == 3 else "HHII"), tag, kind, 1, value)
    return data + bytes(4)


def tiff_header_of_a_mac(width: int, height: int) -> bytes:
    return tiff_header(width, height, ">")


def bigtiff_header(width: int, height: int) -> bytes:
    data = struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, 2)
    return data + struct.pack("<HHQQHHQQ", 256, 16, 1, width, 257, 4, 1, height) + bytes(8)


JPEG, PNG = encoded(".jpg", NOISE), encoded(".png", NOISE)

PROGRESSIVE = encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)

THUMBNAIL = b"Exif\0\0" + exif(1) + JPEG[:3000] + b"\xff\xd9"

WITH_THUMBNAIL = JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(THUMBNAIL) + 2) + THUMBNAIL + JPEG[2:]

TRUNCATABLE = {
    "jpeg": JPEG,
    "progressive": PROGRESSIVE,
    "jpeg with a whole thumbnail": WITH_THUMBNAIL,
    "png": PNG,
    "webp": encoded(".webp", NOISE),
    "webp lossless": encoded(".webp", NOISE, cv2.IMWRITE_WEBP_QUALITY, 101),
    "bmp": encoded(".bmp", NOISE),
    "tiff": pillow("TIFF", "RGB", NOISE),
    "tiff lzw": encoded(".tif", NOISE),
}
