"""Image formats that can be measured, and the headers of their files.

Limits must be checked before a decoder allocates memory, so headers are read without decoding
pixels. OpenCV does not report the orientation and, in some versions, not even a truncated JPEG. A
TIFF's tags decide whether OpenCV can decode it.
"""

from __future__ import annotations

import struct
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.avif import AVIF
from vehanchor.imagery.formats.bmp import BMP
from vehanchor.imagery.formats.heif import HEIC
from vehanchor.imagery.formats.jpeg import JPEG
from vehanchor.imagery.formats.jpeg2000 import JPEG_2000
from vehanchor.imagery.formats.png import PNG
from vehanchor.imagery.formats.tiff import RAW_ADVICE, TIFF
from vehanchor.imagery.formats.webp import WEBP

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_format import ImageFormat
    from vehanchor.imagery.formats.image_header import ImageHeader

IMAGE_FORMATS: dict[str, ImageFormat] = {
    image_format.name: image_format
    for image_format in (JPEG, PNG, WEBP, AVIF, BMP, TIFF, JPEG_2000, HEIC)
}
"""All image formats by name.

Help, messages, lists of files, the page, limits and the choice of a decoder derive from it. So do
the tests of all formats.
"""

SUFFIXES = tuple(chain.from_iterable(image.suffixes for image in IMAGE_FORMATS.values()))
"""Suffixes of all formats."""

FORMAT_BYTES = 32
"""First bytes of a file, by which its format is recognised."""

_VIDEO_ADVICE = (
    "this is a video; save a frame with 'ffmpeg -i FILE -frames:v 1 OUT.png' and send that"
)


class _Unsupported(NamedTuple):
    """Common format that is not supported.

    Attributes:
        offset: offset of its mark in the file.
        mark: bytes by which it is recognised.
        advice: what to do with the file.
    """

    offset: int
    mark: bytes
    advice: str


_UNSUPPORTED = (
    _Unsupported(0, b"GIF8", "a GIF has at most 256 colours; send the original photograph"),
    _Unsupported(
        0,
        b"%PDF",
        "this is a PDF; extract its images with 'pdfimages -all FILE OUT' and send one",
    ),
    _Unsupported(0, b"\xff\x0a", "this is a JPEG XL; save it as JPEG or PNG"),
    _Unsupported(4, b"JXL ", "this is a JPEG XL; save it as JPEG or PNG"),
    _Unsupported(0, b"PK\3\4", "this is an archive; unpack it, and send an image"),
    _Unsupported(0, b"<!DOCTYPE", "this is a page of the web, not the image on it"),
    _Unsupported(0, b"<html", "this is a page of the web, not the image on it"),
    _Unsupported(
        0,
        b"version https://git-lfs",
        "this is a pointer of Git LFS; get the file by 'git lfs pull'",
    ),
    _Unsupported(4, b"ftypmif1", "its images are neither AVIF nor HEIC; convert them to JPEG"),
    _Unsupported(4, b"ftyphe", "this is a HEIC sequence; save one image as JPEG and send that"),
    _Unsupported(4, b"ftypavis", "this is an animation; save one frame as PNG and send that"),
    _Unsupported(4, b"ftypcrx", RAW_ADVICE),
    _Unsupported(0, b"FUJIFILMCCD-RAW", RAW_ADVICE),
    _Unsupported(0, b"IIRO", RAW_ADVICE),
    _Unsupported(0, b"IIRS", RAW_ADVICE),
    _Unsupported(0, b"MMOR", RAW_ADVICE),
    _Unsupported(0, b"IIU\0", RAW_ADVICE),
    _Unsupported(4, b"ftyp", _VIDEO_ADVICE),
    _Unsupported(8, b"AVI ", _VIDEO_ADVICE),
    _Unsupported(0, b"\x1a\x45\xdf\xa3", _VIDEO_ADVICE),
)
"""Unsupported formats; the first that fits counts, so "ftyp" alone means a video."""


def recognise_format(start: bytes) -> ImageFormat | None:
    """Recognise the format by a file's first 32 bytes; None for an unsupported file."""
    for image_format in IMAGE_FORMATS.values():
        if image_format.recognises(start):
            return image_format
    return None


def read_header(read_at: ReadAt) -> ImageHeader:
    """Read format, declared size, orientation and completeness of an image.

    Raises:
        ImageDecodeError: the format is unknown, or the header is damaged.
        ImageTooLargeError: the file has more parts than an image needs.
        ImageFormatError: the file is a camera's raw file.
    """
    start = read_at(0, FORMAT_BYTES)
    image_format = recognise_format(start)
    if image_format is None:
        formats = ", ".join(IMAGE_FORMATS)
        raise ImageDecodeError(f"not an image in one of the formats {formats}: {_advice(start)}")
    try:
        return image_format.read_header(read_at)
    except struct.error:
        raise ImageDecodeError(
            f"the {image_format.name} ends within its header: truncated"
        ) from None


def _advice(start: bytes) -> str:
    """Say what to do with a file of an unsupported format; for an unknown one, show its start."""
    for unsupported in _UNSUPPORTED:
        if start[unsupported.offset :].startswith(unsupported.mark):
            return unsupported.advice
    return f"it starts with {start[:8]!r}"
