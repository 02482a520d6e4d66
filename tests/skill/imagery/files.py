"""Images as files: whole, turned, damaged, with metadata of cameras, or nothing but a header; and as arrays."""

from __future__ import annotations

import io
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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

from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.metadata.camera import CameraMetadata, read_camera
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Reading

WIDTH_PX = 60
HEIGHT_PX = 40


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


def geotiff(
    path: Path, bands_hwc: NDArray[Any], mask: NDArray[Any] | None = None, **profile: Any
) -> Path:
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
        with rasterio.open(
            path, "w", width=width, height=height, count=count, **profile
        ) as dataset:
            dataset.write(np.moveaxis(bands_hwc, -1, 0))
            if mask is not None:
                dataset.write_mask(mask)
    return path


def read_all(image: Any, **options: Any) -> NDArray[np.uint8]:
    with open_raster(image, Reading(**options)) as raster:
        pixels = raster.read()
        assert pixels.shape == (raster.height_px, raster.width_px, 3)
        assert pixels.dtype == np.uint8
        assert pixels.flags.c_contiguous
        return pixels


_TAGS = {
    "ImageWidth": (256, "long", False),
    "ImageLength": (257, "long", False),
    "Make": (0x010F, "ascii", False),
    "Model": (0x0110, "ascii", False),
    "Orientation": (0x0112, "short", False),
    "ApplicationNotes": (0x02BC, "bytes", False),
    "FocalLength": (0x920A, "rational", True),
    "PixelXDimension": (0xA002, "long", True),
    "PixelYDimension": (0xA003, "long", True),
    "FocalPlaneXResolution": (0xA20E, "rational", True),
    "FocalPlaneResolutionUnit": (0xA210, "short", True),
    "DigitalZoomRatio": (0xA404, "rational", True),
    "FocalLengthIn35mmFilm": (0xA405, "short", True),
}
_POSITION_TAGS = {
    "GPSLatitudeRef": (1, "ascii"),
    "GPSLatitude": (2, "degrees"),
    "GPSLongitudeRef": (3, "ascii"),
    "GPSLongitude": (4, "degrees"),
}


def exif(tags: Mapping[str, Any], order: str = "<", pointer_kind: int = 4) -> bytes:
    """A TIFF structure with these tags, those of the camera in a directory of their own."""
    position = [
        _entry(name, value, order) for name, value in tags.items() if name in _POSITION_TAGS
    ]
    first = [
        _entry(name, value, order)
        for name, value in tags.items()
        if name in _TAGS and not _TAGS[name][2]
    ]
    camera = [
        _entry(name, value, order)
        for name, value in tags.items()
        if name in _TAGS and _TAGS[name][2]
    ]
    further = 2 if position else 1
    camera_at = (
        8 + 2 + 12 * (len(first) + further) + 4 + sum(len(raw) for *_, raw in first if len(raw) > 4)
    )
    first.append((0x8769, pointer_kind, 1, struct.pack(order + "I", camera_at)))
    start = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    of_camera = _directory(camera, order, camera_at)
    if not position:
        return start + _directory(first, order, 8) + of_camera
    position_at = camera_at + len(of_camera)
    first.append((0x8825, 4, 1, struct.pack(order + "I", position_at)))
    return (
        start + _directory(first, order, 8) + of_camera + _directory(position, order, position_at)
    )


def _entry(name: str, value: Any, order: str) -> tuple[int, int, int, bytes]:
    tag, kind = _POSITION_TAGS[name] if name in _POSITION_TAGS else _TAGS[name][:2]
    if kind == "degrees":
        return tag, 5, 3, struct.pack(order + "6I", *value)
    if kind in ("ascii", "bytes"):
        raw = value if isinstance(value, bytes) else value.encode() + b"\0"
        return tag, 2 if kind == "ascii" else 1, len(raw), raw + b"\0" * (-len(raw) % 4)
    if kind == "rational":
        fraction = value if isinstance(value, tuple) else (round(value * 10_000), 10_000)
        return tag, 5, 1, struct.pack(order + "II", *fraction)
    if kind == "long":
        return tag, 4, 1, struct.pack(order + "I", value)
    return tag, 3, 1, struct.pack(order + "HH", value, 0)


def _directory(entries: Sequence[tuple[int, int, int, bytes]], order: str, at: int) -> bytes:
    table = b""
    values = b""
    values_at = at + 2 + 12 * len(entries) + 4
    for tag, kind, count, raw in sorted(entries):
        inline = raw if len(raw) <= 4 else struct.pack(order + "I", values_at + len(values))
        values += raw if len(raw) > 4 else b""
        table += struct.pack(order + "HHI", tag, kind, count) + inline
    return struct.pack(order + "H", len(entries)) + table + struct.pack(order + "I", 0) + values


def xmp(namespaces: Mapping[str, str], properties: str, *, before: str = "") -> bytes:
    """A packet whose one description has these attributes (or, with a ``<``, these elements)."""
    named = " ".join(f'xmlns:{prefix}="{address}"' for prefix, address in namespaces.items())
    attributes, elements = ("", properties) if "<" in properties else (properties, "")
    return (
        f'<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>{before}'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="DJI Meta Data" {named} '
        f"{attributes}>{elements}</rdf:Description>"
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"


def jpeg(
    *,
    exif: bytes | None = None,
    xmp: bytes | None = None,
    width_px: int = 80,
    height_px: int = 60,
    more: bytes = b"",
) -> bytes:
    """A JPEG with these blocks before its pixels."""
    plain = encoded(".jpg", smooth_rgb(width_px, height_px))
    blocks = more
    for prefix, block in ((b"Exif\0\0", exif), (XMP_PREFIX, xmp)):
        if block is not None:
            blocks += segment(prefix + block)
    return plain[:2] + blocks + plain[2:]


def segment(body: bytes) -> bytes:
    """A JPEG's segment for metadata."""
    return b"\xff\xe1" + struct.pack(">H", 2 + len(body)) + body


def read_metadata(data: bytes) -> CameraMetadata | None:
    """The camera of a file; None for one that is no image."""

    def read_at(offset: int, count: int) -> bytes:
        return data[offset : offset + count]

    with suppress(ImageDecodeError):
        return read_camera(read_at, read_header(read_at))
    return None


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_with_xmp(packet: bytes, exif_block: bytes) -> bytes:
    """A PNG of 80 x 60 px with both blocks."""
    plain = encoded(".png", smooth_rgb(80, 60))
    text = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet)
    return plain[:33] + text + png_chunk(b"eXIf", exif_block) + plain[33:]


def webp_with_exif(exif_block: bytes, packet: bytes) -> bytes:
    """The chunks of a WebP with both blocks, without pixels but with their size."""
    body = b"WEBPVP8L" + struct.pack("<IBI", 5, 0x2F, 79 | 59 << 14) + b"\0"
    for kind, block in ((b"EXIF", exif_block), (b"XMP ", packet)):
        body += kind + struct.pack("<I", len(block)) + block + b"\0" * (len(block) & 1)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def jpeg_with(orientation: int, order: str = "<") -> bytes:
    data = encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 100)
    comment = b"\xff\xfe\x00\x04hi"
    return (
        data[:2]
        + comment
        + segment(b"Exif\0\0" + exif({"Orientation": orientation}, order))
        + data[2:]
    )


def jpeg_of_a_mac_with(orientation: int) -> bytes:
    return jpeg_with(orientation, ">")


def png_with(orientation: int) -> bytes:
    data = encoded(".png")
    return data[:33] + png_chunk(b"eXIf", exif({"Orientation": orientation})) + data[33:]


def webp_with(orientation: int) -> bytes:
    return pillow(
        "WEBP", "RGB", lossless=True, exif=b"Exif\0\0" + exif({"Orientation": orientation})
    )


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
    return b"\x89PNG\r\n\x1a\n" + png_chunk(
        b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    )


def jpeg_header(width: int, height: int) -> bytes:
    return (
        b"\xff\xd8\xff\xff\xc0"
        + struct.pack(">HBHHB", 17, 8, height, width, 3)
        + bytes(9)
        + b"\xff\xd9"
    )


def bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHH", 54, 0, 54, 40, width, height, 1, 24) + bytes(24)


def os2_bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIHHHH", 26, 0, 26, 12, width, height, 1, 24)


def webp(chunk: bytes, body: bytes) -> bytes:
    return (
        b"RIFF"
        + struct.pack("<I", 12 + len(body))
        + b"WEBP"
        + chunk
        + struct.pack("<I", len(body))
        + body
    )


def webp_header(width: int, height: int) -> bytes:
    return webp(
        b"VP8X", bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    )


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


JPEG = encoded(".jpg", NOISE)
PNG = encoded(".png", NOISE)

PROGRESSIVE = encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)

THUMBNAIL = b"Exif\0\0" + exif({"Orientation": 1}) + JPEG[:3000] + b"\xff\xd9"

WITH_THUMBNAIL = JPEG[:2] + segment(THUMBNAIL) + JPEG[2:]

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
