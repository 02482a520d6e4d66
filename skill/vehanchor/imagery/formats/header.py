"""Headers of image files, read without decoding pixels.

Limits must be checked before a decoder allocates memory. OpenCV does not report the orientation
and, in some versions, not even a truncated JPEG. A TIFF's tags decide whether OpenCV can decode it.
"""

from __future__ import annotations

import struct
from contextlib import suppress

from vehanchor.errors import ImageDecodeError, ImageFormatError, ImageTooLargeError
from vehanchor.imagery.formats.avif import read_avif
from vehanchor.imagery.formats.boxes import still_format
from vehanchor.imagery.formats.ifd import (
    MAX_VALUES,
    TAG_ORIENTATION,
    TIFF_SIGNATURES,
    ReadAt,
    exif_orientation,
    later_directories,
    orientation_of,
    read_ifd,
)
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader, TiffLayout
from vehanchor.imagery.formats.jpeg import EXIF_PREFIX, MAX_SEGMENTS, read_jpeg
from vehanchor.imagery.formats.jpeg2000 import SIGNATURES as JPEG2000_SIGNATURES
from vehanchor.imagery.formats.jpeg2000 import read_jpeg2000

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

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SIGNATURES: dict[str, bytes | tuple[bytes, ...]] = {
    "JPEG": b"\xff\xd8\xff",
    "PNG": _PNG_SIGNATURE,
    "TIFF": TIFF_SIGNATURES,
    "BMP": b"BM",
    "JPEG 2000": JPEG2000_SIGNATURES,
}
_PNG_BANDS = {0: 1, 2: 3}  # grey and RGB; all others, and these with transparency, can become four
_KEPT_CHUNKS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})
_MAX_PNG_CHUNKS = 100_000  # 512 MiB in chunks of 8 KiB, as libpng writes them, would be 65,536
_WEBP_BYTES = 9  # two copies of four bands, and alpha (measured in tests/bombs.py)
_TIFF_COLOURS = (3, 6)  # palette and YCbCr, which OpenCV decodes to three bands
_TIFF_BLOCK_BYTES = 4  # OpenCV decodes a strip or tile of up to 8 bits to four bands
# the first directory, with the orientation, is at the start; JPEG allows no more
_MAX_EXIF_BYTES = 1 << 16

_TAG_WIDTH = 256
_TAG_HEIGHT = 257
_TAG_BITS = 258
_TAG_PHOTOMETRIC = 262
_TAG_SUBFILE = 254
_SUBFILE_REDUCED = 1
_SUBFILE_MASK = 4
_TAG_SAMPLES = 277
_TAG_ROWS_PER_STRIP = 278
_TAG_PLANAR = 284
_TAG_SAMPLE_FORMAT = 339
_TAG_TILE_WIDTH = 322
_TAG_TILE_HEIGHT = 323
_TAG_EXTRA_SAMPLES = 338
_TAG_FURTHER = 330
_TAG_DNG_VERSION = 50706
_RAW_PHOTOMETRIC = (32803, 34892)
# ModelPixelScale, ModelTransformation, GeoKeyDirectory
_GEO_TAGS = frozenset({33550, 34264, 34735})
_RAW_TAGS = frozenset({_TAG_DNG_VERSION})
_TAGS_OF_BANDS = frozenset({_TAG_BITS, _TAG_SAMPLE_FORMAT})  # a value for each band
_TAGS_OF_SOME = frozenset({_TAG_EXTRA_SAMPLES, _TAG_FURTHER, _TAG_SUBFILE})
_TAGS_OF_ONE = frozenset(
    {
        _TAG_WIDTH,
        _TAG_HEIGHT,
        _TAG_PHOTOMETRIC,
        TAG_ORIENTATION,
        _TAG_SAMPLES,
        _TAG_ROWS_PER_STRIP,
        _TAG_PLANAR,
        _TAG_TILE_WIDTH,
        _TAG_TILE_HEIGHT,
    }
)


def image_format(start: bytes) -> str | None:
    """Tell the format, as in ``IMAGE_FORMATS``, by a file's first 32 bytes; None for any other file."""
    if start[:4] == b"RIFF" and start[8:12] == b"WEBP":
        return "WebP"
    return next(
        (name for name, mark in _SIGNATURES.items() if start.startswith(mark)), None
    ) or still_format(start)


def read_header(read_at: ReadAt) -> ImageHeader:
    """Read format, declared size, orientation and completeness; HEIC has none here.

    Raises:
        ImageDecodeError: the format is unknown, or the header is damaged.
    """
    start = read_at(0, 32)
    name = image_format(start) or ""
    readers = {
        "JPEG": read_jpeg,
        "PNG": _read_png,
        "TIFF": _read_tiff,
        "WebP": _read_webp,
        "BMP": _read_bmp,
    }
    read = {**readers, "AVIF": read_avif, "JPEG 2000": read_jpeg2000}.get(name)
    if read is None:
        raise ImageDecodeError(
            f"not an image in one of the formats {', '.join(IMAGE_FORMATS)}: {_advice(start)}"
        )
    try:
        return read(read_at)
    except struct.error:
        raise ImageDecodeError(f"the {name} ends within its header: truncated") from None


_ADVICE = (  # offset and first bytes of common unsupported formats, and what to do with them
    (0, b"GIF8", "a GIF has at most 256 colours; send the original photograph"),
    (0, b"%PDF", "this is a PDF; extract its images with 'pdfimages -all FILE OUT' and send one"),
    (4, b"ftypmif1", "its images are neither AVIF nor HEIC; convert them to JPEG"),
    (4, b"ftyphe", "this is a HEIC sequence; save one image as JPEG and send that"),
    (4, b"ftypavis", "this is an animation; save one frame as PNG and send that"),
    (
        4,
        b"ftypcrx",
        _RAW := "this is a camera's raw file; export the photograph as JPEG or TIFF in full size",
    ),
    *((0, mark, _RAW) for mark in (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")),
    (
        4,
        b"ftyp",
        _VIDEO
        := "this is a video; save a frame with 'ffmpeg -i FILE -frames:v 1 OUT.png' and send that",
    ),
    (8, b"AVI ", _VIDEO),
    (0, b"\x1a\x45\xdf\xa3", _VIDEO),
)


def _advice(start: bytes) -> str:
    advice = next(
        (words for at, mark, words in _ADVICE if start[at : at + len(mark)] == mark), None
    )
    return advice or f"it starts with {start[:8]!r}"


def _check_for_preview(
    read_at: ReadAt, tags: dict[int, tuple[int, ...]], width: int, height: int
) -> None:
    """Refuse a raw file, whose first picture is a preview.

    Raises:
        ImageFormatError: the file is raw, or a picture within the first one is larger, or the first
            one is marked as reduced and a later one is larger. Overviews are smaller, and pages of
            a document are not marked.
    """
    if (
        _TAG_DNG_VERSION in tags
        or tags.get(_TAG_PHOTOMETRIC, (0,))[0] in _RAW_PHOTOMETRIC
        or read_at(8, 2) == b"CR"
    ):
        raise ImageFormatError(_RAW)
    reduced = tags.get(_TAG_SUBFILE, (0,))[0] & _SUBFILE_REDUCED
    for offset in (*tags.get(_TAG_FURTHER, ()), *(later_directories(read_at) if reduced else ())):
        with suppress(struct.error, ImageDecodeError):  # a damaged directory holds no picture
            further = read_ifd(read_at, frozenset({_TAG_WIDTH, _TAG_HEIGHT}), offset=offset)
            (columns, *_), (rows, *_) = (
                further.get(_TAG_WIDTH, (0,)),
                further.get(_TAG_HEIGHT, (0,)),
            )
            if columns * rows > width * height:
                raise ImageFormatError(
                    f"the first picture of the file, {width} x {height} px, is a preview of "
                    f"another with {columns} x "
                    f"{rows} px, as in cameras' raw files; export the photograph as JPEG or "
                    "TIFF in full size"
                )


def _read_png(read_at: ReadAt) -> ImageHeader:
    length, kind, width, height, depth, colour = struct.unpack(">I4sIIBB", read_at(8, 18))
    if kind != b"IHDR" or length != 13:
        raise ImageDecodeError("the PNG does not begin with its IHDR chunk: damaged")
    orientation = 1
    complete = False
    metadata: list[tuple[int, int]] = []
    position = 8
    n_chunks = 0
    while len(head := read_at(position, 8)) == 8:
        n_chunks += 1
        if n_chunks > _MAX_PNG_CHUNKS:
            raise ImageTooLargeError(
                f"the PNG has more than {_MAX_PNG_CHUNKS} chunks; save it again"
            )
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IHDR" and n_chunks > 1:
            raise ImageDecodeError("the PNG declares its size twice: damaged")
        if kind == b"IEND":
            # OpenCV allocates any length
            complete = length == 0 and len(read_at(position + 8, 4)) == 4
            break
        if kind in (b"eXIf", b"iTXt"):
            metadata.append((position + 8, length))
        if kind == b"eXIf":
            orientation = exif_orientation(read_at(position + 8, min(length, _MAX_EXIF_BYTES)))
        position += length + 12
    pixel_bytes = _PNG_BANDS.get(colour, 4) * (2 if depth == 16 else 1)
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
    parts = [png[:8]]
    start = position = 8
    while len(head := png[position : position + 8]) == 8:
        length, kind = struct.unpack(">I4s", head)
        after = position + length + 12
        if kind not in _KEPT_CHUNKS:
            parts.append(png[start:position])
            start = after
        position = after
        if kind == b"IEND":
            break
    return b"".join([*parts, png[start:position]]) if len(parts) > 1 else png


def _read_webp(read_at: ReadAt) -> ImageHeader:
    (riff_bytes,) = struct.unpack("<I", read_at(4, 4))
    end = riff_bytes + 8
    complete = len(read_at(end - 1, 1)) == 1
    sizes: set[tuple[int, int]] = set()
    orientation = 1
    metadata: list[tuple[int, int]] = []
    position = 12
    n_chunks = 0
    while position < end and len(head := read_at(position, 8)) == 8:
        n_chunks += 1
        if n_chunks > MAX_SEGMENTS:
            raise ImageTooLargeError(f"the WebP has more than {MAX_SEGMENTS} chunks; save it again")
        kind, length = struct.unpack("<4sI", head)
        body = read_at(position + 8, 10)
        if kind == b"VP8X":
            sizes.add(
                (1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little"))
            )
        elif kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", body, 6)
            sizes.add((width & 0x3FFF, height & 0x3FFF))
        elif kind == b"VP8L":
            (packed,) = struct.unpack_from("<I", body, 1)
            sizes.add((1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)))
        elif kind in (b"EXIF", b"XMP "):
            metadata.append((position + 8, length))
        if kind == b"EXIF":
            payload = read_at(position + 8, min(length, _MAX_EXIF_BYTES))
            orientation = exif_orientation(payload.removeprefix(EXIF_PREFIX))
        position += 8 + length + (length & 1)
    if len(sizes) != 1:
        found = "two different sizes: damaged" if sizes else "no image chunk: truncated or damaged"
        raise ImageDecodeError(f"the WebP holds {found}")
    ((width, height),) = sizes
    decoding_bytes = _WEBP_BYTES * width * height
    return ImageHeader(
        "WebP",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=decoding_bytes,
        metadata=tuple(metadata),
    )


def _read_bmp(read_at: ReadAt) -> ImageHeader:
    (header_bytes,) = struct.unpack("<I", read_at(14, 4))
    if header_bytes == 12:  # OS/2
        width, height = struct.unpack("<HH", read_at(18, 4))
    else:
        width, height = struct.unpack("<ii", read_at(18, 8))
    # a negative height means top-down rows
    width = abs(width)
    height = abs(height)
    return ImageHeader("BMP", width, height, decoding_bytes=COPIES * 4 * width * height)


def _read_tiff(read_at: ReadAt) -> ImageHeader:
    tags = read_ifd(read_at, _TAGS_OF_ONE | _TAGS_OF_BANDS | _TAGS_OF_SOME, _GEO_TAGS | _RAW_TAGS)
    if _TAG_WIDTH not in tags or _TAG_HEIGHT not in tags:
        raise ImageDecodeError("the TIFF's first directory declares no width and height: damaged")
    repeated = [tag for tag in _TAGS_OF_ONE if len(tags.get(tag, (0,))) != 1]
    if repeated:
        raise ImageDecodeError(
            f"the TIFF's tag {repeated[0]} has several values instead of one: damaged"
        )
    (width,) = tags[_TAG_WIDTH]
    (height,) = tags[_TAG_HEIGHT]
    (bands,) = tags.get(_TAG_SAMPLES, (1,))
    _check_for_preview(read_at, tags, width=width, height=height)
    for tag in _TAGS_OF_BANDS:
        if len(tags.get(tag, (0,))) not in (1, min(bands, MAX_VALUES)):
            raise ImageDecodeError(
                f"the TIFF's tag {tag} has {len(tags[tag])} values for {bands} bands: damaged"
            )
    layout = TiffLayout(
        bands=bands,
        bits=tags.get(_TAG_BITS, (1,)),
        sample_format=tags.get(_TAG_SAMPLE_FORMAT, (1,))[0],
        photometric=tags.get(_TAG_PHOTOMETRIC, (1,))[0],
        planar=tags.get(_TAG_PLANAR, (1,))[0] == 2,
        georeferenced=not _GEO_TAGS.isdisjoint(tags),
        alpha=not {1, 2}.isdisjoint(tags.get(_TAG_EXTRA_SAMPLES, ())),
        block_px=_block_px(tags, width, height),
        mask_block_px=_mask_block_px(read_at),
    )
    pixel_bytes = max(layout.pixel_bytes, 3 if layout.photometric in _TIFF_COLOURS else 1)
    block_bytes = max(_TIFF_BLOCK_BYTES, pixel_bytes)
    return ImageHeader(
        "TIFF",
        width,
        height,
        orientation=orientation_of(tags),
        tiff=layout,
        decoding_bytes=COPIES * width * height * pixel_bytes + layout.block_px * block_bytes,
    )


def _mask_block_px(read_at: ReadAt) -> int:
    """Compute the pixels of the largest strip or tile of a mask, which has its own directory; 0 without one."""
    largest = 0
    for offset in later_directories(read_at):
        (kind, *_) = read_ifd(read_at, frozenset({_TAG_SUBFILE}), offset=offset).get(
            _TAG_SUBFILE, (0,)
        )
        if kind & _SUBFILE_MASK:
            tags = read_ifd(read_at, _TAGS_OF_ONE, offset=offset)
            (width, *_), (height, *_) = tags.get(_TAG_WIDTH, (0,)), tags.get(_TAG_HEIGHT, (0,))
            largest = max(largest, _block_px(tags, width, height))
    return largest


def _block_px(tags: dict[int, tuple[int, ...]], width: int, height: int) -> int:
    """Compute the pixels of a strip or tile; the larger if both are declared."""
    (rows,) = tags.get(_TAG_ROWS_PER_STRIP, (height,))
    strip_px = width * min(rows, height)
    if _TAG_TILE_WIDTH not in tags and _TAG_TILE_HEIGHT not in tags:
        return strip_px
    if _TAG_TILE_WIDTH not in tags or _TAG_TILE_HEIGHT not in tags:
        raise ImageDecodeError("the TIFF declares only one side of its tiles: damaged")
    tile_px = tags[_TAG_TILE_WIDTH][0] * tags[_TAG_TILE_HEIGHT][0]
    return max(tile_px, strip_px) if _TAG_ROWS_PER_STRIP in tags else tile_px
