"""Headers of image files, read without decoding pixels.

Limits must be checked before a decoder allocates memory. OpenCV does not report the orientation
and, in some versions, not even a truncated JPEG. A TIFF's tags decide whether OpenCV can decode it.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.avif import read_avif
from vehanchor.imagery.formats.boxes import still_format
from vehanchor.imagery.formats.heif import read_heic
from vehanchor.imagery.formats.ifd import TIFF_SIGNATURES, ReadAt, exif_orientation
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader
from vehanchor.imagery.formats.jpeg import EXIF_PREFIX, MAX_SEGMENTS, read_jpeg
from vehanchor.imagery.formats.jpeg2000 import SIGNATURES as JPEG2000_SIGNATURES
from vehanchor.imagery.formats.jpeg2000 import read_jpeg2000
from vehanchor.imagery.formats.tiff import RAW_ADVICE, read_tiff

IMAGE_FORMATS: dict[str, tuple[str, ...]] = {
    "JPEG": (".jpg", ".jpeg"),
    "PNG": (".png",),
    "WebP": (".webp",),
    "AVIF": (".avif",),
    "BMP": (".bmp",),
    "TIFF": (".tif", ".tiff"),
    "JPEG 2000": (".jp2",),
    "HEIC": (".heic",),
}
"""Suffixes of each image format; help, messages and lists of files derive from it."""

FORMAT_BYTES = 32
"""First bytes of a file, by which its format is recognised."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SIGNATURES: dict[str, bytes | tuple[bytes, ...]] = {
    "JPEG": b"\xff\xd8\xff",
    "PNG": _PNG_SIGNATURE,
    "TIFF": TIFF_SIGNATURES,
    "BMP": b"BM",
    "JPEG 2000": JPEG2000_SIGNATURES,
}
"""First bytes of the formats; WebP, AVIF and HEIC are recognised by later bytes."""

_PNG_BANDS = {0: 1, 2: 3}
"""Decoded bands of grey and RGB; all others, and these with transparency, can become four."""

_ESSENTIAL_CHUNKS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})
_MAX_PNG_CHUNKS = 100_000
"""Maximum number of chunks; 512 MiB in chunks of 8 KiB, as libpng writes them, are 65,536."""

_WEBP_PIXEL_BYTES = 9
"""Memory for decoding: two copies of four bands, and alpha (measured in tests/bombs.py)."""

_MAX_EXIF_BYTES = 1 << 16
"""Bytes of an EXIF block to read: JPEG allows no more, and the orientation is at the start."""

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


def image_format(start: bytes) -> str | None:
    """Recognise the format by a file's first 32 bytes.

    Returns:
        A name in ``IMAGE_FORMATS``; None for any other file.
    """
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "WebP"
    for name, signature in _SIGNATURES.items():
        if start.startswith(signature):
            return name
    return still_format(start)


def read_header(read_at: ReadAt) -> ImageHeader:
    """Read format, declared size, orientation and completeness of an image.

    Raises:
        ImageDecodeError: the format is unknown, or the header is damaged.
        ImageTooLargeError: the file has more parts than an image needs.
        ImageFormatError: the file is a camera's raw file.
    """
    start = read_at(0, FORMAT_BYTES)
    name = image_format(start) or ""
    readers = {
        "JPEG": read_jpeg,
        "PNG": _read_png,
        "TIFF": read_tiff,
        "WebP": _read_webp,
        "BMP": _read_bmp,
        "AVIF": read_avif,
        "JPEG 2000": read_jpeg2000,
        "HEIC": read_heic,
    }
    reader = readers.get(name)
    if reader is None:
        formats = ", ".join(IMAGE_FORMATS)
        raise ImageDecodeError(f"not an image in one of the formats {formats}: {_advice(start)}")
    try:
        return reader(read_at)
    except struct.error:
        raise ImageDecodeError(f"the {name} ends within its header: truncated") from None


def _advice(start: bytes) -> str:
    """Say what to do with a file of an unsupported format; for an unknown one, show its start."""
    for unsupported in _UNSUPPORTED:
        if start[unsupported.offset :].startswith(unsupported.mark):
            return unsupported.advice
    return f"it starts with {start[:8]!r}"


def _read_png(read_at: ReadAt) -> ImageHeader:
    """Read the header of a PNG from its chunks.

    Raises:
        ImageDecodeError: the file is damaged.
        ImageTooLargeError: there are too many chunks.
        struct.error: the file ends within its header.
    """
    length, kind, width, height, depth, colour = struct.unpack(">I4sIIBB", read_at(8, 18))
    if kind != b"IHDR" or length != 13:
        raise ImageDecodeError("the PNG does not begin with its IHDR chunk: damaged")
    orientation = 1
    complete = False
    metadata: list[tuple[int, int]] = []
    position = len(_PNG_SIGNATURE)
    n_chunks = 0
    while True:
        head = read_at(position, 8)
        if len(head) < 8:
            break
        n_chunks += 1
        if n_chunks > _MAX_PNG_CHUNKS:
            raise ImageTooLargeError(
                f"the PNG has more than {_MAX_PNG_CHUNKS} chunks; save it again"
            )
        length, kind = struct.unpack(">I4s", head)
        content = position + 8
        if kind == b"IHDR" and n_chunks > 1:
            raise ImageDecodeError("the PNG declares its size twice: damaged")
        if kind == b"IEND":
            # OpenCV allocates whatever length the end mark declares.
            has_checksum = len(read_at(content, 4)) == 4
            complete = length == 0 and has_checksum
            break
        if kind in (b"eXIf", b"iTXt"):
            metadata.append((content, length))
        if kind == b"eXIf":
            exif = read_at(content, min(length, _MAX_EXIF_BYTES))
            orientation = exif_orientation(exif)
        position += length + 12  # with length, kind and checksum
    sample_bytes = 2 if depth == 16 else 1
    pixel_bytes = _PNG_BANDS.get(colour, 4) * sample_bytes
    return ImageHeader(
        "PNG",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=COPIES * width * height * pixel_bytes,
        metadata=tuple(metadata),
    )


def without_ancillary_chunks(png: bytes) -> bytes:
    """Remove texts, profiles and animation from a PNG whose header has been checked.

    libpng would unpack a thousand texts of 8 MB, compressed a thousandfold, and write a line to
    stderr for every chunk that it rejects.
    """
    # Essential chunks that follow each other are copied as one run.
    runs = [png[: len(_PNG_SIGNATURE)]]
    run_start = len(_PNG_SIGNATURE)
    position = run_start
    while True:
        head = png[position : position + 8]
        if len(head) < 8:
            break
        length, kind = struct.unpack(">I4s", head)
        chunk_end = position + length + 12
        if kind not in _ESSENTIAL_CHUNKS:
            runs.append(png[run_start:position])
            run_start = chunk_end
        position = chunk_end
        if kind == b"IEND":
            break
    if len(runs) == 1:  # nothing to remove: the file is not copied
        return png
    runs.append(png[run_start:position])
    return b"".join(runs)


def _read_webp(read_at: ReadAt) -> ImageHeader:
    """Read the header of a WebP from its chunks.

    Raises:
        ImageDecodeError: the file has no size, or two different ones.
        ImageTooLargeError: there are too many chunks.
        struct.error: the file ends within its header.
    """
    (riff_bytes,) = struct.unpack("<I", read_at(4, 4))
    end = riff_bytes + 8
    complete = len(read_at(end - 1, 1)) == 1
    sizes: set[tuple[int, int]] = set()
    orientation = 1
    metadata: list[tuple[int, int]] = []
    position = 12
    n_chunks = 0
    while position < end:
        head = read_at(position, 8)
        if len(head) < 8:
            break
        n_chunks += 1
        if n_chunks > MAX_SEGMENTS:
            raise ImageTooLargeError(f"the WebP has more than {MAX_SEGMENTS} chunks; save it again")
        kind, length = struct.unpack("<4sI", head)
        content = position + 8
        if kind in (b"VP8X", b"VP8 ", b"VP8L"):
            sizes.add(_webp_chunk_size(kind, read_at(content, 10)))
        elif kind in (b"EXIF", b"XMP "):
            metadata.append((content, length))
        if kind == b"EXIF":
            exif = read_at(content, min(length, _MAX_EXIF_BYTES))
            orientation = exif_orientation(exif.removeprefix(EXIF_PREFIX))
        position += 8 + length + length % 2  # chunks begin at even offsets
    if not sizes:
        raise ImageDecodeError("the WebP holds no image chunk: truncated or damaged")
    if len(sizes) > 1:
        raise ImageDecodeError("the WebP holds two different sizes: damaged")
    width, height = sizes.pop()
    return ImageHeader(
        "WebP",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=_WEBP_PIXEL_BYTES * width * height,
        metadata=tuple(metadata),
    )


def _webp_chunk_size(kind: bytes, content: bytes) -> tuple[int, int]:
    """Read width and height from the first 10 bytes of a chunk.

    Raises:
        struct.error: the file ends within the chunk.
    """
    if kind == b"VP8X":  # the whole canvas, 24 bits a side
        width = 1 + int.from_bytes(content[4:7], "little")
        height = 1 + int.from_bytes(content[7:10], "little")
        return width, height
    if kind == b"VP8 ":  # lossy: 14 bits a side, below two bits of scaling
        width, height = struct.unpack_from("<HH", content, 6)
        return width & 0x3FFF, height & 0x3FFF
    # Lossless: 14 bits a side, one after the other.
    (packed,) = struct.unpack_from("<I", content, 1)
    width = 1 + (packed & 0x3FFF)
    height = 1 + (packed >> 14 & 0x3FFF)
    return width, height


def _read_bmp(read_at: ReadAt) -> ImageHeader:
    """Read the header of a BMP.

    Raises:
        struct.error: the file ends within its header.
    """
    (header_bytes,) = struct.unpack("<I", read_at(14, 4))
    is_os2 = header_bytes == 12
    if is_os2:
        width, height = struct.unpack("<HH", read_at(18, 4))
    else:
        width, height = struct.unpack("<ii", read_at(18, 8))
    # A negative height means rows from top to bottom.
    width = abs(width)
    height = abs(height)
    return ImageHeader("BMP", width, height, decoding_bytes=COPIES * 4 * width * height)
