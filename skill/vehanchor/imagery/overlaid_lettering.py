"""Lettering over a photograph, and the photograph without it.

Programs write and draw in exactly one colour, which stands out among the colours of a photograph:
nearly all pixels that resemble it have it. Thin strokes, half transparent ones and those that a
JPEG file changed are not found.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.sources.arrays import ArrayRaster

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, RgbImage

    Packed: TypeAlias = NDArray[np.uint32]
    """``[h, w]`` one number for each colour."""

# Numbers without a measurement beside them are choices.

# Most pixels that are searched: those of a screen or a film of 3840 x 2160. A choice.
_MAX_PIXELS = 8_300_000
# Fewest pixels of a colour of lettering whose right neighbour has it, too, and their least share.
_MIN_PIXELS = 40
_MIN_SHARE = 0.0003
# Colours that are examined, the commonest first.
_MAX_COLOURS = 12
# Grey levels by which a colour resembles another one, and share of the pixels of similar colours
# that have exactly this one.
_SIMILAR_LEVELS = 10
_EXACT_SHARE = 0.5
# Every so many rows are looked at first. A choice.
_ROWS_APART = 8
# Largest share of the image that is painted over.
_MAX_COVERED = 0.45
# Side of the square by which strokes are widened, to their outlines and smooth edges, pixels.
_WIDENED_PX = 7
# Distance over which the surroundings are continued into strokes, pixels.
_REACH_PX = 3.0


def paint_over_lettering(raster: Raster) -> Raster:
    """Paint the lettering of an image over; return it unchanged if none is found.

    Images that are read by windows, and those above 8.3 megapixels, are not searched for lettering.
    """
    if not raster.in_memory or raster.width_px * raster.height_px > _MAX_PIXELS:
        return raster
    picture = raster.read()
    painted = without_lettering(picture)
    if painted is picture:
        return raster
    return ArrayRaster(painted, raster.source, None, stretch=False)


def without_lettering(picture: RgbImage) -> RgbImage:
    """Paint the lettering of a picture over with what is around it.

    Args:
        picture: ``[h, w, 3]`` RGB.

    Returns:
        The same picture if no lettering is found, or too much.
    """
    packed = _packed(picture)
    strokes = np.zeros(picture.shape[:2], np.uint8)
    for colour in _run_colours(packed):
        n_exact = int(np.count_nonzero(packed == colour))
        most_similar = n_exact / _EXACT_SHARE
        unpacked = np.array([colour >> 16 & 255, colour >> 8 & 255, colour & 255], np.int16)
        lowest = np.clip(unpacked - _SIMILAR_LEVELS, 0, 255)
        highest = np.clip(unpacked + _SIMILAR_LEVELS, 0, 255)
        # Some rows of a photograph already have more similar pixels.
        for rows in (picture[::_ROWS_APART], picture):
            is_similar = cv2.inRange(rows, lowest, highest)
            if cv2.countNonZero(is_similar) > most_similar:
                break
        else:
            strokes |= np.asarray(is_similar, np.uint8)
    if not strokes.any():
        return picture
    widened = cv2.dilate(strokes, np.ones((_WIDENED_PX, _WIDENED_PX), np.uint8))
    if cv2.countNonZero(widened) > _MAX_COVERED * widened.size:
        return picture
    return np.asarray(cv2.inpaint(picture, widened, _REACH_PX, cv2.INPAINT_TELEA), np.uint8)


def _packed(picture: RgbImage) -> Packed:
    """Pack each colour into one number, with red above green and blue, and 255 above all."""
    opaque = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2BGRA), np.uint8)
    return opaque.view("<u4").reshape(picture.shape[:2])


def _run_colours(packed: Packed) -> list[int]:
    """List the commonest colours of neighbours in a row that are equal."""
    is_equal = packed[:, 1:] == packed[:, :-1]
    equal = np.compress(is_equal.ravel(), packed[:, 1:])
    colours, counts = np.unique(equal, return_counts=True)
    is_common = counts >= max(_MIN_PIXELS, _MIN_SHARE * is_equal.size)
    order = np.argsort(-counts, kind="stable")[:_MAX_COLOURS]
    chosen: list[int] = colours[order[is_common[order]]].tolist()
    return chosen
