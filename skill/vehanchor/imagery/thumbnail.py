"""Thumbnail in EXIF: programs that cut a part out of a photograph often leave that of the whole.

Such a crop keeps the camera's facts, and often the proportions and even the stated size, so that it
looks like a whole photograph or a smaller copy. Its thumbnail shows more than the image.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageError
from vehanchor.imagery.formats.ifd import in_memory, later_directories, read_ifd
from vehanchor.imagery.formats.jpeg import read_jpeg
from vehanchor.imagery.metadata.blocks import metadata_blocks
from vehanchor.imagery.raster import oriented
from vehanchor.imagery.tiles import read_small_grey

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.raster import Raster

    Grey: TypeAlias = NDArray[np.uint8]
    """``[h, w]`` grey values."""

# JPEGInterchangeFormat and its length, in the second directory.
_TAG_OFFSET = 0x0201
_TAG_BYTES = 0x0202
_MAX_BYTES = 1 << 17
_MAX_SIDE_PX = 640
_MIN_SIDE_PX = 48
# The image is reduced to this, above the size of thumbnails.
_SMALL_SIDE_PX = 1024
# Grey levels from black or white within which rows and columns at the border of a thumbnail are
# bars around the picture.
_MAX_BAR = 24
_WHITE = 255
# Correlation with the thumbnail. A whole photograph has more than the first; a crop has less, and
# more than the second with a part. Choices: whole photographs have 0.9 and more.
_MAX_OF_CROP = 0.5
_MIN_OF_PART = 0.7
# Sides of the parts that are tried, relative to the thumbnail's: smaller ones have too few pixels,
# and larger ones hardly change the lens. A part that is 3 % too large correlates no more.
_LARGEST_PART = 0.92
_SMALLEST_PART = 0.25
_STEP = 0.985

CLAUSE = "the thumbnail in its metadata shows more than the image"


def with_crop_by_thumbnail(
    camera: CameraMetadata | None, raster: Raster, read_at: ReadAt, header: ImageHeader
) -> CameraMetadata | None:
    """Note in the camera metadata that an image is a crop, if its thumbnail shows more.

    Args:
        camera: metadata of the image; None if it has none.
        raster: the image, decoded.
        read_at: reads the file.
        header: its header.
    """
    if camera is None or camera.crop:
        return camera
    thumbnail = _thumbnail(read_at, header)
    if thumbnail is None:
        return camera
    small = read_small_grey(raster, _SMALL_SIDE_PX)
    if small is None:
        return camera
    picture, _ = small
    if not is_crop(picture, oriented(thumbnail, raster.orientation)):
        return camera
    return replace(camera, crop=CLAUSE)


def is_crop(picture: Grey, thumbnail: Grey) -> bool:
    """Test whether a picture shows a part of what its thumbnail shows.

    A picture that does not resemble its thumbnail may have been edited, which proves nothing.

    Args:
        picture: ``[h, w]``, larger than the thumbnail.
        thumbnail: ``[h, w]``, upright.
    """
    # Bars, and a dark sea or snow at the border of a photograph, look alike.
    without_bars = _without_bars(thumbnail)
    if min(without_bars.shape) < _MIN_SIDE_PX:
        return False
    if _shows_whole(thumbnail, picture) or _shows_whole(without_bars, picture):
        return False
    thumbnail = without_bars
    height, width = picture.shape
    # The largest size at which the picture fits into the thumbnail.
    fitting = min(thumbnail.shape[0] / height, thumbnail.shape[1] / width)
    share = _LARGEST_PART
    while share >= _SMALLEST_PART:
        size = (round(share * fitting * width), round(share * fitting * height))
        part = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        if _correlation(thumbnail, np.asarray(part, np.uint8)) >= _MIN_OF_PART:
            return True
        share *= _STEP
    return False


def _shows_whole(thumbnail: Grey, picture: Grey) -> bool:
    """Test whether a thumbnail resembles the whole picture, however that was turned or mirrored."""
    for side in (thumbnail, thumbnail[:, ::-1]):
        for quarters in range(4):
            turned = np.ascontiguousarray(np.rot90(side, quarters))
            whole = cv2.resize(picture, turned.shape[::-1], interpolation=cv2.INTER_AREA)
            if _correlation(turned, np.asarray(whole, np.uint8)) >= _MAX_OF_CROP:
                return True
    return False


def _correlation(thumbnail: Grey, part: Grey) -> float:
    """Correlate a part with the thumbnail at the best place; 0 for a part without texture."""
    if min(part.shape) < 2 or part.min() == part.max():
        return 0.0
    return float(cv2.matchTemplate(thumbnail, part, cv2.TM_CCOEFF_NORMED).max())


def _without_bars(thumbnail: Grey) -> Grey:
    """Cut off black or white bars, which fill a thumbnail of other proportions than its picture."""
    for is_picture in (thumbnail > _MAX_BAR, thumbnail < _WHITE - _MAX_BAR):
        rows = np.flatnonzero(is_picture.any(axis=1))
        columns = np.flatnonzero(is_picture.any(axis=0))
        if not len(rows):
            return thumbnail
        if len(rows) < len(is_picture) or len(columns) < is_picture.shape[1]:
            picture_rows = slice(rows[0], rows[-1] + 1)
            picture_columns = slice(columns[0], columns[-1] + 1)
            return thumbnail[picture_rows, picture_columns]
    return thumbnail


def _thumbnail(read_at: ReadAt, header: ImageHeader) -> Grey | None:
    """Decode the thumbnail of a file; None without one, and for one that is damaged or large."""
    if header.tiff is not None:
        return None  # its second directory is another page
    blocks, _ = metadata_blocks(read_at, header)
    for block in blocks:
        data = _bytes_of_thumbnail(block)
        if data and _is_small(data):
            flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
            try:
                pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
            except cv2.error:
                continue
            if pixels is not None:
                return np.asarray(pixels, np.uint8)
    return None


def _bytes_of_thumbnail(block: ReadAt) -> bytes:
    """Read the JPEG that the second directory of an EXIF block names; empty without one."""
    try:
        directory = next(later_directories(block), None)
        if directory is None:
            return b""
        tags = read_ifd(block, frozenset({_TAG_OFFSET, _TAG_BYTES}), offset=directory, whole=False)
    except (struct.error, ImageDecodeError):
        return b""
    offsets = tags.get(_TAG_OFFSET, ())
    lengths = tags.get(_TAG_BYTES, ())
    if len(offsets) != 1 or len(lengths) != 1 or lengths[0] > _MAX_BYTES:
        return b""
    return block(offsets[0], lengths[0])


def _is_small(data: bytes) -> bool:
    """Test whether a thumbnail is a whole JPEG with few pixels, before it is decoded."""
    try:
        header = read_jpeg(in_memory(data))
    except (struct.error, ImageError):
        return False
    return header.complete and max(header.width_px, header.height_px) <= _MAX_SIDE_PX
