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
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, RgbImage

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
    strokes = np.zeros(picture.shape[:2], np.uint8)
    for colour in _run_colours(picture):
        lowest = np.clip(colour - _SIMILAR_LEVELS, 0, 255)
        highest = np.clip(colour + _SIMILAR_LEVELS, 0, 255)
        is_similar = cv2.inRange(picture, lowest, highest)
        is_exact = cv2.inRange(picture, colour, colour)
        if cv2.countNonZero(is_exact) >= _EXACT_SHARE * cv2.countNonZero(is_similar):
            strokes |= np.asarray(is_similar, np.uint8)
    if not strokes.any():
        return picture
    widened = cv2.dilate(strokes, np.ones((_WIDENED_PX, _WIDENED_PX), np.uint8))
    if cv2.countNonZero(widened) > _MAX_COVERED * widened.size:
        return picture
    return np.asarray(cv2.inpaint(picture, widened, _REACH_PX, cv2.INPAINT_TELEA), np.uint8)


def _run_colours(picture: RgbImage) -> NDArray[np.int16]:
    """List the commonest colours ``[n, 3]`` of neighbours in a row that are equal."""
    is_equal = (picture[:, 1:] == picture[:, :-1]).all(axis=2)
    # One number for each colour is sorted much faster than three.
    red, green, blue = picture[:, 1:][is_equal].astype(np.int32).T
    packed, counts = np.unique(red << 16 | green << 8 | blue, return_counts=True)
    is_common = counts >= max(_MIN_PIXELS, _MIN_SHARE * is_equal.size)
    order = np.argsort(-counts, kind="stable")[:_MAX_COLOURS]
    chosen = packed[order[is_common[order]]]
    colours = [chosen >> 16, chosen >> 8 & 255, chosen & 255]
    return np.column_stack(colours).astype(np.int16)
