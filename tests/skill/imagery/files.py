"""Images for tests: as arrays, and as files.

The files are whole, turned, or damaged; others have metadata of cameras, or only a header.
"""

from __future__ import annotations

import base64
import io
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

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
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.metadata.camera import CameraMetadata, read_camera
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Reading

WIDTH_PX = 60
HEIGHT_PX = 40


def smooth_rgb(width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX) -> NDArray[np.uint8]:
    """Make a colour ramp, gentle enough for JPEG; every flip, turn or swap of bands changes it."""
    x = np.linspace(0, 1, width_px)[np.newaxis, :]
    y = np.linspace(0, 1, height_px)[:, np.newaxis]
    red = 40 + 180 * x + 0 * y
    green = 200 - 150 * y + 0 * x
    blue = 60 + 60 * x * y
    return np.rint(np.stack([red, green, blue], axis=-1)).astype(np.uint8)


RGB = smooth_rgb()

NOISE = np.random.default_rng(7).integers(0, 256, (90, 130, 3), dtype=np.uint8)


def encoded(suffix: str, rgb: NDArray[Any] = RGB, *parameters: int) -> bytes:
    """Encode an image with OpenCV."""
    bgr = rgb[..., ::-1] if rgb.ndim == 3 else rgb
    done, data = cv2.imencode(suffix, bgr, parameters)
    assert done
    return data.tobytes()


def pillow(format_name: str, mode: str, rgb: NDArray[Any] = RGB, **options: Any) -> bytes:
    """Encode an image with Pillow, in one of its modes."""
    buffer = io.BytesIO()
    image = Image.fromarray(rgb).convert(mode)
    image.save(buffer, format_name, **options)
    return buffer.getvalue()


def geotiff(
    path: Path, bands_hwc: NDArray[Any], mask: NDArray[Any] | None = None, **profile: Any
) -> Path:
    """Write [h, w, bands] as a GeoTIFF, by default of 0.25 m/px in UTM 31N."""
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


def header_of(data: bytes) -> ImageHeader:
    """Read the header of an encoded image."""
    return read_header(in_memory(data))


def read_all(image: Any, **options: Any) -> NDArray[np.uint8]:
    """Read a whole image, and check the form of its pixels."""
    with open_raster(image, Reading(**options)) as raster:
        pixels = raster.read()
        assert pixels.shape == (raster.height_px, raster.width_px, 3)
        assert pixels.dtype == np.uint8
        assert pixels.flags.c_contiguous
        return pixels


_FIRST_TAGS = {
    "ImageWidth": (256, "long"),
    "ImageLength": (257, "long"),
    "Make": (0x010F, "ascii"),
    "Model": (0x0110, "ascii"),
    "Orientation": (0x0112, "short"),
    "ApplicationNotes": (0x02BC, "bytes"),
}
_CAMERA_TAGS = {
    "FocalLength": (0x920A, "rational"),
    "PixelXDimension": (0xA002, "long"),
    "PixelYDimension": (0xA003, "long"),
    "FocalPlaneXResolution": (0xA20E, "rational"),
    "FocalPlaneResolutionUnit": (0xA210, "short"),
    "DigitalZoomRatio": (0xA404, "rational"),
    "FocalLengthIn35mmFilm": (0xA405, "short"),
}
_POSITION_TAGS = {
    "GPSLatitudeRef": (1, "ascii"),
    "GPSLatitude": (2, "degrees"),
    "GPSLongitudeRef": (3, "ascii"),
    "GPSLongitude": (4, "degrees"),
}
_CAMERA_POINTER = 0x8769
_POSITION_POINTER = 0x8825
_BYTE = 1
_ASCII = 2
_SHORT = 3
_LONG = 4
_RATIONAL = 5

_Entry: TypeAlias = tuple[int, int, int, bytes]
"""Tag, type, number of values, and the values."""


def exif(tags: Mapping[str, Any], order: str = "<", pointer_kind: int = _LONG) -> bytes:
    """Make a TIFF structure with these tags, those of the camera in a directory of their own."""
    first = _entries(tags, _FIRST_TAGS, order)
    camera = _entries(tags, _CAMERA_TAGS, order)
    position = _entries(tags, _POSITION_TAGS, order)
    n_pointers = 2 if position else 1
    long_values = [values for *_, values in first if len(values) > 4]
    table_bytes = 2 + 12 * (len(first) + n_pointers) + 4
    camera_offset = 8 + table_bytes + sum(map(len, long_values))
    camera_directory = _directory(camera, order, camera_offset)
    position_directory = b""
    first.append((_CAMERA_POINTER, pointer_kind, 1, struct.pack(order + "I", camera_offset)))
    if position:
        position_offset = camera_offset + len(camera_directory)
        position_directory = _directory(position, order, position_offset)
        first.append((_POSITION_POINTER, _LONG, 1, struct.pack(order + "I", position_offset)))
    signature = b"II*\0" if order == "<" else b"MM\0*"
    head = signature + struct.pack(order + "I", 8)
    return head + _directory(first, order, 8) + camera_directory + position_directory


def _entries(
    values: Mapping[str, Any], tags: Mapping[str, tuple[int, str]], order: str
) -> list[_Entry]:
    """Make the entries of those values that have one of these tags."""
    return [
        _entry(*tags[name], value=value, order=order)
        for name, value in values.items()
        if name in tags
    ]


def _entry(tag: int, kind: str, *, value: Any, order: str) -> _Entry:
    match kind:
        case "degrees":
            return tag, _RATIONAL, 3, struct.pack(order + "6I", *value)
        case "ascii" | "bytes":
            text = value if isinstance(value, bytes) else value.encode() + b"\0"
            padding = b"\0" * (-len(text) % 4)
            return tag, _ASCII if kind == "ascii" else _BYTE, len(text), text + padding
        case "rational":
            fraction = value if isinstance(value, tuple) else (round(value * 10_000), 10_000)
            return tag, _RATIONAL, 1, struct.pack(order + "II", *fraction)
        case "long":
            return tag, _LONG, 1, struct.pack(order + "I", value)
        case _:
            return tag, _SHORT, 1, struct.pack(order + "HH", value, 0)


def _directory(entries: Sequence[_Entry], order: str, offset: int) -> bytes:
    """Make a directory at an offset; its long values follow it."""
    table = b""
    long_values = b""
    values_offset = offset + 2 + 12 * len(entries) + 4
    for tag, kind, n_values, values in sorted(entries):
        table += struct.pack(order + "HHI", tag, kind, n_values)
        if len(values) <= 4:
            table += values
        else:
            table += struct.pack(order + "I", values_offset + len(long_values))
            long_values += values
    count = struct.pack(order + "H", len(entries))
    no_further_directory = struct.pack(order + "I", 0)
    return count + table + no_further_directory + long_values


def xmp(namespaces: Mapping[str, str], properties: str, *, before: str = "") -> bytes:
    """Make a packet whose one description has these attributes (or, with a ``<``, elements)."""
    named = " ".join(f'xmlns:{prefix}="{address}"' for prefix, address in namespaces.items())
    attributes = properties
    elements = ""
    if "<" in properties:
        attributes = ""
        elements = properties
    return (
        f'<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>{before}'
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="DJI Meta Data" {named} '
        f"{attributes}>{elements}</rdf:Description>"
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


EXIF_PREFIX = b"Exif\0\0"
XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"


def jpeg(
    *,
    exif: bytes | None = None,
    xmp: bytes | None = None,
    width_px: int = 80,
    height_px: int = 60,
    more: bytes = b"",
) -> bytes:
    """Make a JPEG with these blocks before its pixels."""
    plain = encoded(".jpg", smooth_rgb(width_px, height_px))
    blocks = more
    if exif is not None:
        blocks += segment(EXIF_PREFIX + exif)
    if xmp is not None:
        blocks += segment(XMP_PREFIX + xmp)
    return after_start(plain, blocks)


def after_start(jpeg: bytes, blocks: bytes) -> bytes:
    """Insert segments after a JPEG's first marker."""
    return jpeg[:2] + blocks + jpeg[2:]


def segment(body: bytes) -> bytes:
    """Make a JPEG's segment for metadata."""
    return b"\xff\xe1" + struct.pack(">H", 2 + len(body)) + body


def read_metadata(data: bytes) -> CameraMetadata | None:
    """Read the camera of a file; None for one that is not an image."""
    with suppress(ImageDecodeError):
        return read_camera(in_memory(data), header_of(data))
    return None


PNG_HEAD_BYTES = 33
"""Bytes of a PNG's signature and first chunk."""


def png_chunk(kind: bytes, body: bytes) -> bytes:
    checksum = zlib.crc32(kind + body)
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", checksum)


def after_head(png: bytes, chunks: bytes) -> bytes:
    """Insert chunks after a PNG's first one."""
    return png[:PNG_HEAD_BYTES] + chunks + png[PNG_HEAD_BYTES:]


def png_with_xmp(packet: bytes, exif_block: bytes) -> bytes:
    """Make a PNG of 80 x 60 px with both blocks."""
    text = png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet)
    plain = encoded(".png", smooth_rgb(80, 60))
    return after_head(plain, text + png_chunk(b"eXIf", exif_block))


def webp_with_exif(exif_block: bytes, packet: bytes) -> bytes:
    """Make the chunks of a WebP with both blocks, without pixels but with their size."""
    sides = 79 | 59 << 14
    body = b"WEBPVP8L" + struct.pack("<IBI", 5, 0x2F, sides) + b"\0"
    for kind, block in ((b"EXIF", exif_block), (b"XMP ", packet)):
        padding = b"\0" * (len(block) % 2)
        body += kind + struct.pack("<I", len(block)) + block + padding
    return b"RIFF" + struct.pack("<I", len(body)) + body


def jpeg_with(orientation: int, order: str = "<") -> bytes:
    data = encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 100)
    comment = b"\xff\xfe\x00\x04hi"
    block = exif({"Orientation": orientation}, order)
    return after_start(data, comment + segment(EXIF_PREFIX + block))


def jpeg_of_a_mac_with(orientation: int) -> bytes:
    return jpeg_with(orientation, ">")


def png_with(orientation: int) -> bytes:
    block = exif({"Orientation": orientation})
    return after_head(encoded(".png"), png_chunk(b"eXIf", block))


def webp_with(orientation: int) -> bytes:
    block = exif({"Orientation": orientation})
    return pillow("WEBP", "RGB", lossless=True, exif=EXIF_PREFIX + block)


def tiff_with(orientation: int) -> bytes:
    return pillow("TIFF", "RGB", tiffinfo={274: orientation})


@contextmanager
def without_rasterio() -> Iterator[None]:
    """Hide rasterio as if it were not installed."""
    modules = [name for name in sys.modules if name.partition(".")[0] == "rasterio"]
    with pytest.MonkeyPatch.context() as patch:
        for name in modules:
            patch.delitem(sys.modules, name)
        patch.setitem(sys.modules, "rasterio", None)
        yield


def png_header(width: int, height: int) -> bytes:
    content = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", content)


def jpeg_header(width: int, height: int) -> bytes:
    frame = struct.pack(">HBHHB", 17, 8, height, width, 3) + bytes(9)
    return b"\xff\xd8\xff\xff\xc0" + frame + b"\xff\xd9"


def bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIiiHH", 54, 0, 54, 40, width, height, 1, 24) + bytes(24)


def os2_bmp_header(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IIIIHHHH", 26, 0, 26, 12, width, height, 1, 24)


def webp(chunk: bytes, body: bytes) -> bytes:
    content = b"WEBP" + chunk + struct.pack("<I", len(body)) + body
    return b"RIFF" + struct.pack("<I", len(content)) + content


def webp_header(width: int, height: int) -> bytes:
    sides = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return webp(b"VP8X", bytes(4) + sides)


def webp_lossy_header(width: int, height: int) -> bytes:
    return webp(b"VP8 ", b"\0\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height))


def webp_lossless_header(width: int, height: int) -> bytes:
    sides = (width - 1) | (height - 1) << 14
    return webp(b"VP8L", b"\x2f" + struct.pack("<I", sides) + b"\0")


def tiff_header(width: int, height: int, order: str = "<") -> bytes:
    entries = [
        (256, _LONG, width),
        (257, _LONG, height),
        (258, _SHORT, 8),
        (262, _SHORT, 1),
        (277, _SHORT, 1),
    ]
    mark = b"II" if order == "<" else b"MM"
    data = mark + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, value in entries:
        entry_format = "HHIHxx" if kind == _SHORT else "HHII"
        data += struct.pack(order + entry_format, tag, kind, 1, value)
    return data + bytes(4)


def tiff_header_of_a_mac(width: int, height: int) -> bytes:
    return tiff_header(width, height, ">")


def bigtiff_header(width: int, height: int) -> bytes:
    data = struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, 2)
    data += struct.pack("<HHQQ", 256, 16, 1, width)
    data += struct.pack("<HHQQ", 257, _LONG, 1, height)
    return data + bytes(8)


JPEG = encoded(".jpg", NOISE)
PNG = encoded(".png", NOISE)

PROGRESSIVE = encoded(".jpg", NOISE, cv2.IMWRITE_JPEG_PROGRESSIVE, 1)

THUMBNAIL = EXIF_PREFIX + exif({"Orientation": 1}) + JPEG[:3000] + b"\xff\xd9"

WITH_THUMBNAIL = after_start(JPEG, segment(THUMBNAIL))

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

HEIC = base64.b64decode(
    "AAAAHGZ0eXBoZWl4AAAAAG1pZjFoZWl4bWlhZgAAAcltZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAA"
    "AAAAAAAAADRpbG9jAAAAAERAAAIAAQAAAAAB7QABAAAAAAAAAMQAAgAAAAACsQABAAAAAAAAACQAAAA4aWluZgAAAAAA"
    "AgAAABVpbmZlAgAAAAABAABodmMxAAAAABVpbmZlAgAAAQACAABFeGlmAAAAAA5waXRtAAAAAAABAAABCGlwcnAAAADn"
    "aXBjbwAAAHdodmNDAQQIAAAAnjgAAAAAHvAA/P/4+AAADwNgAAEAF0ABDAH//wQIAAADAJ44AAADAAAeugJAYQABACpC"
    "AQEECAAAAwCeOAAAAwAAHpAEECCy3VyU1zcBDQYEAAADAGQAAAMABCBiAAEACEQBwXMYMAiQAAAAE2NvbHJuY2x4AAEA"
    "DQAGgAAAABRpc3BlAAAAAAAAAEAAAABAAAAAKGNsYXAAAABAAAAAAQAAADAAAAABAAAAAAAAAAL////wAAAAAgAAABBw"
    "aXhpAAAAAAMICAgAAAAJaXJvdAMAAAAZaXBtYQAAAAAAAAABAAEGgQIDBYSGAAAAGmlyZWYAAAAAAAAADmNkc2MAAgAB"
    "AAEAAADwbWRhdAAAAMAoAa8GOFtj5Wb/Su5JaK3xpPa5v+cNv//6XD//7SlxVQ3/u7Ur4I++nH7Y/03+agIZ/3dqV8Ef"
    "fTj9sf6b/NX/zRnlDEjFJYob8WXUaP3S/3n772ztftfM0IQ1xhBKfsX+i6xQ/0FrxtrkEE2Vcp1C8EU0Kldd5xz/hCkE"
    "ekIv/7X/vr/74sH5Y3aVPWZPL26irBJPr88ZBD6e227FRktwW7KmA5R8Atn2YtenfFfI3a2+Pvg1ehkS+Il9d83kFrsA"
    "AAAGRXhpZgAATU0AKgAAAAgAAQESAAMAAAABAAYAAAAAAAA="
)
"""No encoder of HEVC is free of the GPL, so this is a file that pillow-heif encoded once."""
