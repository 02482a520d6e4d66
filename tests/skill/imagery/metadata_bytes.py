"""Files with metadata, written byte by byte: EXIF and XMP as cameras write them, and as no camera would."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from tests.skill.imagery.files import encoded, smooth_rgb
from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.metadata.camera import CameraMetadata, read_camera

_TAGS = {
    "ImageWidth": (256, "long", False),
    "ImageLength": (257, "long", False),
    "Make": (0x010F, "ascii", False),
    "Model": (0x0110, "ascii", False),
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
    "GPSAltitudeRef": (5, "bytes"),
    "GPSAltitude": (6, "rational"),
}


def exif(tags: Mapping[str, Any], order: str = "<", pointer_kind: int = 4) -> bytes:
    """A TIFF structure with these tags, those of the camera in a directory of their own."""
    position = [_entry(name, value, order) for name, value in tags.items() if name in _POSITION_TAGS]
    first = [_entry(name, value, order) for name, value in tags.items() if name in _TAGS and not _TAGS[name][2]]
    camera = [_entry(name, value, order) for name, value in tags.items() if name in _TAGS and _TAGS[name][2]]
    further = 2 if position else 1
    camera_at = 8 + 2 + 12 * (len(first) + further) + 4 + sum(len(raw) for *_, raw in first if len(raw) > 4)
    first.append((0x8769, pointer_kind, 1, struct.pack(order + "I", camera_at)))
    start = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    of_camera = _directory(camera, order, camera_at)
    if not position:
        return start + _directory(first, order, 8) + of_camera
    position_at = camera_at + len(of_camera)
    first.append((0x8825, 4, 1, struct.pack(order + "I", position_at)))
    return start + _directory(first, order, 8) + of_camera + _directory(position, order, position_at)


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
    table, values = b"", b""
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
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="DJI Meta Data" {named} {attributes}>{elements}</rdf:Description>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"


def jpeg(
    *, exif: bytes | None = None, xmp: bytes | None = None, width_px: int = 80, height_px: int = 60, more: bytes = b""
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


def read(data: bytes) -> CameraMetadata | None:
    """The camera of a file; None for one that is no image."""

    def read_at(offset: int, count: int) -> bytes:
        return data[offset : offset + count]

    with suppress(ImageDecodeError):
        return read_camera(read_at, read_header(read_at))
    return None


def png_with_xmp(packet: bytes, exif_block: bytes) -> bytes:
    """A PNG of 80 x 60 px with both blocks."""
    plain = encoded(".png", smooth_rgb(80, 60))
    chunks = b""
    for kind, body in ((b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet), (b"eXIf", exif_block)):
        chunks += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return plain[:33] + chunks + plain[33:]


def webp_with_exif(exif_block: bytes, packet: bytes) -> bytes:
    """The chunks of a WebP with both blocks, without pixels but with their size."""
    body = b"WEBPVP8L" + struct.pack("<IBI", 5, 0x2F, 79 | 59 << 14) + b"\0"
    for kind, block in ((b"EXIF", exif_block), (b"XMP ", packet)):
        body += kind + struct.pack("<I", len(block)) + block + b"\0" * (len(block) & 1)
    return b"RIFF" + struct.pack("<I", len(body)) + body
