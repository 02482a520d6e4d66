"""Header of a TIFF: its size, and the layout that decides which decoder can read it."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, TypeAlias

from vehanchor.errors import ImageDecodeError, ImageFormatError
from vehanchor.imagery.formats.ifd import (
    MAX_VALUES,
    TAG_ORIENTATION,
    TIFF_SIGNATURES,
    later_directories,
    orientation_of,
    read_ifd,
)
from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader, TiffLayout

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

RAW_ADVICE = "this is a camera's raw file; export the photograph as JPEG or TIFF in full size"

_TAG_SUBFILE = 254
_TAG_WIDTH = 256
_TAG_HEIGHT = 257
_TAG_BITS = 258
_TAG_COMPRESSION = 259
_TAG_PHOTOMETRIC = 262
_TAG_SAMPLES = 277
_TAG_ROWS_PER_STRIP = 278
_TAG_PLANAR = 284
_TAG_TILE_WIDTH = 322
_TAG_TILE_HEIGHT = 323
_TAG_SUB_DIRECTORIES = 330
_TAG_EXTRA_SAMPLES = 338
_TAG_SAMPLE_FORMAT = 339
_TAG_DNG_VERSION = 50706

_GEO_TAGS = frozenset({33550, 34264, 34735})
"""ModelPixelScale, ModelTransformation and GeoKeyDirectory."""

_RAW_TAGS = frozenset({_TAG_DNG_VERSION})
_TAG_NO_DATA = 42113
"""GDAL's value of pixels without data, as text."""

_TAGS_PER_BAND = frozenset({_TAG_BITS, _TAG_SAMPLE_FORMAT})
"""Tags with a value for each band."""

_TAGS_OF_SEVERAL_VALUES = frozenset({_TAG_EXTRA_SAMPLES, _TAG_SUB_DIRECTORIES, _TAG_SUBFILE})
_TAGS_OF_ONE_VALUE = frozenset(
    {
        _TAG_WIDTH,
        _TAG_HEIGHT,
        _TAG_COMPRESSION,
        _TAG_PHOTOMETRIC,
        TAG_ORIENTATION,
        _TAG_SAMPLES,
        _TAG_ROWS_PER_STRIP,
        _TAG_PLANAR,
        _TAG_TILE_WIDTH,
        _TAG_TILE_HEIGHT,
    }
)

_SUBFILE_REDUCED = 1
_SUBFILE_MASK = 4
_RAW_PHOTOMETRIC = (32803, 34892)
"""Photometric interpretations of raw files: colour filter array, and linear raw."""

_THREE_BAND_PHOTOMETRIC = (3, 6)
"""Palette and YCbCr, which OpenCV decodes to three bands."""

# TIFF's SampleFormat and PhotometricInterpretation.
_UNSIGNED = 1
_FLOAT = 3
_WHITE_IS_ZERO = 0
_BLACK_IS_ZERO = 1
_RGB = 2
_PALETTE = 3
_YCBCR = 6
_PLANAR = 2
_ALPHA_SAMPLES = {1, 2}
_OPENCV_COMPRESSIONS = frozenset({1, 2, 3, 4, 5, 7, 8, 32773, 32946})
"""Compressions of all builds of OpenCV: none, fax, LZW, JPEG, Deflate and PackBits.

GDAL reads others, such as WebP, Zstandard and LERC.
"""

_UNCOMPRESSED = 1
_PLAIN_TILE_PX = 1024
"""OpenCV 5 refuses uncompressed tiles whose number of pixels is no multiple of this (measured)."""

_MIN_BLOCK_PIXEL_BYTES = 4
"""Bytes per pixel of a strip or tile: OpenCV decodes one of up to 8 bits to four bands."""

_Tags: TypeAlias = dict[int, tuple[int, ...]]
"""Values of a directory's tags, by their numbers."""


def read_tiff(read_at: ReadAt) -> ImageHeader:
    """Read the header of a TIFF from its first directory.

    Raises:
        ImageDecodeError: the directory is damaged or ambiguous.
        ImageFormatError: the file is a camera's raw file.
        struct.error: the file ends within the directory.
    """
    tags = read_ifd(
        read_at,
        _TAGS_OF_ONE_VALUE | _TAGS_PER_BAND | _TAGS_OF_SEVERAL_VALUES,
        _GEO_TAGS | _RAW_TAGS | {_TAG_NO_DATA},
    )
    if _TAG_WIDTH not in tags or _TAG_HEIGHT not in tags:
        raise ImageDecodeError("the TIFF's first directory declares no width and height: damaged")
    for tag in _TAGS_OF_ONE_VALUE:
        if tag in tags and len(tags[tag]) != 1:
            raise ImageDecodeError(
                f"the TIFF's tag {tag} has several values instead of one: damaged"
            )
    width = tags[_TAG_WIDTH][0]
    height = tags[_TAG_HEIGHT][0]
    _check_for_preview(read_at, tags, width=width, height=height)
    layout = _layout(read_at, tags, width=width, height=height)
    min_pixel_bytes = 3 if layout.photometric in _THREE_BAND_PHOTOMETRIC else 1
    pixel_bytes = max(min_pixel_bytes, layout.pixel_bytes)
    block_bytes = layout.block_px * max(_MIN_BLOCK_PIXEL_BYTES, pixel_bytes)
    return ImageHeader(
        "TIFF",
        width,
        height,
        orientation=orientation_of(tags),
        tiff=layout,
        decoding_bytes=COPIES * width * height * pixel_bytes + block_bytes,
    )


def decoded_by_opencv(layout: TiffLayout) -> bool:
    """Test whether OpenCV decodes a TIFF of this layout correctly and without loss."""
    if layout.bands not in (1, 3, 4) or layout.planar:
        return False
    if layout.compression not in _OPENCV_COMPRESSIONS:
        return False
    is_plain = layout.tiled and layout.compression == _UNCOMPRESSED
    if is_plain and layout.block_px % _PLAIN_TILE_PX:
        return False
    # OpenCV reads pixels without data like all others.
    if layout.mask_block_px or layout.has_no_data_value:
        return False
    bits = set(layout.bits)
    if layout.sample_format == _FLOAT:
        return bits in ({32}, {64}) and layout.photometric in (_BLACK_IS_ZERO, _RGB)
    if layout.sample_format != _UNSIGNED or bits not in ({1}, {8}, {16}):
        return False
    if layout.photometric == _WHITE_IS_ZERO:
        return bits != {16}
    return layout.photometric in (_BLACK_IS_ZERO, _RGB, _PALETTE, _YCBCR)


def _layout(read_at: ReadAt, tags: _Tags, *, width: int, height: int) -> TiffLayout:
    """Collect the storage layout from the first directory and from those of masks.

    Raises:
        ImageDecodeError: there are no bands, a tag has neither one value nor one for each band, or
            tiles have one side.
    """
    bands = _first_value(tags, _TAG_SAMPLES, default=1)
    if bands == 0:
        raise ImageDecodeError("the TIFF declares pixels without bands: damaged")
    for tag in _TAGS_PER_BAND:
        if tag in tags and len(tags[tag]) not in (1, min(bands, MAX_VALUES)):
            raise ImageDecodeError(
                f"the TIFF's tag {tag} has {len(tags[tag])} values for {bands} bands: damaged"
            )
    extra_samples = tags.get(_TAG_EXTRA_SAMPLES, ())
    return TiffLayout(
        bands=bands,
        bits=tags.get(_TAG_BITS, (1,)),
        sample_format=_first_value(tags, _TAG_SAMPLE_FORMAT, default=1),
        photometric=_first_value(tags, _TAG_PHOTOMETRIC, default=1),
        planar=_first_value(tags, _TAG_PLANAR, default=1) == _PLANAR,
        compression=_first_value(tags, _TAG_COMPRESSION, default=1),
        georeferenced=not _GEO_TAGS.isdisjoint(tags),
        alpha=not _ALPHA_SAMPLES.isdisjoint(extra_samples),
        block_px=_block_px(tags, width, height),
        mask_block_px=_mask_block_px(read_at),
        has_no_data_value=_TAG_NO_DATA in tags,
        tiled=_TAG_TILE_WIDTH in tags,
        other_pages=_other_pages(read_at),
    )


def _first_value(tags: _Tags, tag: int, *, default: int) -> int:
    """Get a tag's first value; the default if the tag is absent."""
    return tags[tag][0] if tag in tags else default


def _check_for_preview(read_at: ReadAt, tags: _Tags, *, width: int, height: int) -> None:
    """Refuse a raw file, whose first picture is a preview.

    Overviews are smaller than the first picture, and pages of a document are not marked as reduced,
    so both stay.

    Raises:
        ImageFormatError: the file is raw, or a picture within the first one is larger, or the first
            one is marked as reduced and a later one is larger.
    """
    is_dng = _TAG_DNG_VERSION in tags
    is_mosaic = _first_value(tags, _TAG_PHOTOMETRIC, default=0) in _RAW_PHOTOMETRIC
    is_canon = read_at(8, 2) == b"CR"
    if is_dng or is_mosaic or is_canon:
        raise ImageFormatError(RAW_ADVICE)
    offsets = list(tags.get(_TAG_SUB_DIRECTORIES, ()))
    if _first_value(tags, _TAG_SUBFILE, default=0) & _SUBFILE_REDUCED:
        offsets.extend(later_directories(read_at))
    for offset in offsets:
        columns, rows = _picture_size(read_at, offset)
        if columns * rows > width * height:
            raise ImageFormatError(
                f"the first picture of the file, {width} x {height} px, is a preview of another "
                f"with {columns} x {rows} px, as in cameras' raw files; export the photograph as "
                "JPEG or TIFF in full size"
            )


def _picture_size(read_at: ReadAt, offset: int) -> tuple[int, int]:
    """Read width and height of the picture in a directory; 0 and 0 if the directory is damaged."""
    try:
        tags = read_ifd(read_at, frozenset({_TAG_WIDTH, _TAG_HEIGHT}), offset=offset)
    except (struct.error, ImageDecodeError):
        return 0, 0
    width = _first_value(tags, _TAG_WIDTH, default=0)
    height = _first_value(tags, _TAG_HEIGHT, default=0)
    return width, height


def _other_pages(read_at: ReadAt) -> tuple[tuple[int, int], ...]:
    """List width and height of the pages after the first; overviews and masks are no pages."""
    pages = []
    for offset in later_directories(read_at):
        try:
            tags = read_ifd(read_at, frozenset({_TAG_SUBFILE}), offset=offset)
        except (struct.error, ImageDecodeError):
            continue
        if _first_value(tags, _TAG_SUBFILE, default=0) & (_SUBFILE_REDUCED | _SUBFILE_MASK):
            continue
        width, height = _picture_size(read_at, offset)
        if width and height:
            pages.append((width, height))
    return tuple(pages)


def _mask_block_px(read_at: ReadAt) -> int:
    """Compute the pixels of the largest strip or tile of a mask; 0 without one.

    A mask has a directory of its own.
    """
    largest = 0
    for offset in later_directories(read_at):
        subfile = read_ifd(read_at, frozenset({_TAG_SUBFILE}), offset=offset)
        if not _first_value(subfile, _TAG_SUBFILE, default=0) & _SUBFILE_MASK:
            continue
        tags = read_ifd(read_at, _TAGS_OF_ONE_VALUE, offset=offset)
        width = _first_value(tags, _TAG_WIDTH, default=0)
        height = _first_value(tags, _TAG_HEIGHT, default=0)
        largest = max(largest, _block_px(tags, width, height))
    return largest


def _block_px(tags: _Tags, width: int, height: int) -> int:
    """Compute the pixels of a strip or tile; of the larger if both are declared.

    Raises:
        ImageDecodeError: only one side of the tiles is declared.
    """
    (rows_per_strip,) = tags.get(_TAG_ROWS_PER_STRIP, (height,))
    strip_px = width * min(rows_per_strip, height)
    if _TAG_TILE_WIDTH not in tags and _TAG_TILE_HEIGHT not in tags:
        return strip_px
    if _TAG_TILE_WIDTH not in tags or _TAG_TILE_HEIGHT not in tags:
        raise ImageDecodeError("the TIFF declares only one side of its tiles: damaged")
    tile_px = tags[_TAG_TILE_WIDTH][0] * tags[_TAG_TILE_HEIGHT][0]
    if _TAG_ROWS_PER_STRIP in tags:
        return max(tile_px, strip_px)
    return tile_px


TIFF = ImageFormat(
    name="TIFF",
    suffixes=(".tif", ".tiff"),
    recognises=starts_with(*TIFF_SIGNATURES),
    read_header=read_tiff,
    gdal_driver="GTiff",
)
"""TIFF; ``decoded_by_opencv`` and the file's size decide which files are read by windows."""
