"""The photograph in a composed picture: in a page, a slide, or the window of a program.

Pages and programs have paper, panels and bars of exactly one colour, which no camera takes. Strips
of these colours separate what they show: margins, gaps between lines, and what is around pictures.
The picture is cut along them, again and again (the recursive XY cut of Nagy and Seth, 1984). What
is left in one piece is a line of text, an icon, a chart, or a photograph, which is large and hardly
has flat pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import cv2
import numpy as np

from vehanchor.imagery.drawing import measure_drawing_chance
from vehanchor.imagery.raster import Raster, Window
from vehanchor.imagery.tiles import read_small_grey

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import RgbImage, StoredPixels

    Grey: TypeAlias = NDArray[np.uint8]
    """``[h, w]`` grey values."""

    Mask: TypeAlias = NDArray[np.bool_]
    """``[h, w]`` pixels with a property."""

_Value = TypeVar("_Value", bound=np.generic)

_N_GREYS = 256
# Numbers without a measurement beside them are choices.

# Longest side of the reduced image that is cut; pictures of screens are hardly larger.
_SIDE_PX = 2048
# Least side of a photograph, pixels of the reduced image. A choice: the network of the scene-scale
# prior sees little in less.
_MIN_SIDE_PX = 96
# Share of the pixels that a colour of paper, panels or bars has at least, with equal neighbours.
_PANEL_SHARE = 0.02
# Grey levels by which a pixel of a strip differs from these colours, because JPEG files ripple, and
# share of such pixels in its rows.
_PANEL_LEVELS = 12
_PLAIN_SHARE = 0.95
# Rows or columns of a strip that separates: thinner ones are lines, such as those of a map's grid.
_MIN_STRIP_PX = 3
# Pixels of the thickest frame around a photograph.
_MAX_FRAME_PX = 3
# Largest shares of flat pixels and of pixels in the colours of panels, and largest chance to be
# drawn, of a photograph; grey levels by which neighbours of flat pixels differ. Of 217 drawings,
# some of them compressed or scanned, 4 have a piece that passes; 13 with the limits 0.6 and 1.
_MAX_FLAT_SHARE = 0.45
_MAX_PANEL_SHARE = 0.4
_MAX_DRAWING_CHANCE = 0.1
_FLAT_LEVELS = 2
# Area of a further photograph, over that of the largest, from which it counts.
_SECOND_AREA = 0.1
# Least share of pixels with equal neighbours beside the photograph. Beside the parts that are cut
# from photographs of water it is at most 0.22, beside those of 60 pages, slides and programs at
# least 0.5.
_MIN_EQUAL_BESIDE = 0.4


class PartRaster(Raster):
    """Rectangular part of an image, in its own pixels.

    Args:
        raster: the image, which stays open.
        window: the part.
    """

    def __init__(self, raster: Raster, window: Window) -> None:
        super().__init__(raster.source, window.width_px, window.height_px)
        self._raster = raster
        self.origin_px = (window.x_px, window.y_px)
        self.in_memory = raster.in_memory

    def read(self, window: Window | None = None) -> RgbImage:
        """Read a window of the part; see ``Raster.read``."""
        window = self._checked(window)
        left, top = self.origin_px
        in_image = Window(
            left + window.x_px,
            top + window.y_px,
            width_px=window.width_px,
            height_px=window.height_px,
        )
        return np.ascontiguousarray(self._raster.read(in_image))

    def _read_stored(self, window: Window) -> StoredPixels:
        """Refuse: ``read`` takes the pixels from the image."""
        raise NotImplementedError


def find_photographs(raster: Raster) -> list[Raster]:
    """Find the photographs in a picture that has plain margins, panels or text beside them.

    The file of a camera, and a map, is a photograph as it is.

    Args:
        raster: the picture.

    Returns:
        The parts that are photographs, the largest first; the picture itself if it is a photograph
        without anything beside it, if it shows none, and if it is read by windows.
    """
    is_map = raster.georeference_gsd_m_per_px is not None
    if raster.camera is not None or is_map or not raster.in_memory:
        return [raster]
    small = read_small_grey(raster, _SIDE_PX)
    if small is None:
        return [raster]
    grey, factor = small
    equal = _equal_to_neighbours(grey)
    is_panel = _in_panel_colours(grey, equal)
    if is_panel is None:
        return [raster]
    height, width = grey.shape
    whole = _Piece(0, 0, right=width, bottom=height)
    pieces = sorted(_cut(is_panel, whole), key=_area, reverse=True)
    photographs: list[_Piece] = []
    for piece in pieces:
        if photographs and _area(piece) < _SECOND_AREA * _area(photographs[0]):
            break
        if _flat_share(piece.of(grey)) > _MAX_FLAT_SHARE:
            continue
        if piece.of(is_panel).mean() > _MAX_PANEL_SHARE:
            continue
        part = PartRaster(raster, _window(piece, factor))
        if measure_drawing_chance(part) <= _MAX_DRAWING_CHANCE:
            photographs.append(piece)
    if photographs in ([], [whole]):
        return [raster]
    framed = [_without_frame(grey, piece) for piece in photographs]
    n_beside = grey.size - sum(_area(piece) for piece in framed)
    n_equal_beside = equal.sum() - sum(piece.of(equal).sum() for piece in framed)
    if n_equal_beside < _MIN_EQUAL_BESIDE * n_beside:
        return [raster]
    return [PartRaster(raster, _window(piece, factor)) for piece in framed]


class _Piece(NamedTuple):
    """Rectangle of a reduced image: its first column and row, and those behind its last ones."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, pixels: NDArray[_Value]) -> NDArray[_Value]:
        """Cut the piece from the image, or from a mask."""
        return pixels[self.top : self.bottom, self.left : self.right]


def _area(piece: _Piece) -> int:
    return (piece.right - piece.left) * (piece.bottom - piece.top)


def _window(piece: _Piece, factor: int) -> Window:
    """Convert a piece of a reduced image to pixels of the image.

    A pixel at its border may hold pixels of both sides, and is left out.
    """
    margin = 0 if factor == 1 else 1
    return Window(
        (piece.left + margin) * factor,
        (piece.top + margin) * factor,
        width_px=(piece.right - piece.left - 2 * margin) * factor,
        height_px=(piece.bottom - piece.top - 2 * margin) * factor,
    )


def _equal_to_neighbours(grey: Grey) -> Mask:
    """Test which pixels have the value of all their neighbours."""
    around = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(grey, around) == cv2.erode(grey, around))


def _in_panel_colours(grey: Grey, equal: Mask) -> Mask | None:
    """Test which pixels nearly have a colour of paper, panels or bars; None without such a colour.

    Args:
        grey: the image.
        equal: pixels with the value of all their neighbours.
    """
    counts = np.bincount(grey[equal], minlength=_N_GREYS)
    levels = np.arange(_N_GREYS)
    is_near = np.zeros(_N_GREYS, np.bool_)
    for colour in np.flatnonzero(counts >= _PANEL_SHARE * grey.size):
        is_near |= np.abs(levels - colour) <= _PANEL_LEVELS
    if not is_near.any():
        return None
    return np.asarray(is_near[grey])


def _cut(is_panel: Mask, piece: _Piece) -> list[_Piece]:
    """Cut a piece along strips of panels, until none is left; small pieces are left out."""
    pixels = piece.of(is_panel)
    if min(pixels.shape) < _MIN_SIDE_PX:
        return []
    parts = []
    for first, behind in _runs_between(pixels.mean(axis=1) >= _PLAIN_SHARE):
        parts.append(piece._replace(top=piece.top + first, bottom=piece.top + behind))
    if parts == [piece]:
        parts = []
        for first, behind in _runs_between(pixels.mean(axis=0) >= _PLAIN_SHARE):
            parts.append(piece._replace(left=piece.left + first, right=piece.left + behind))
    if parts == [piece]:
        return [piece]
    return [smaller for part in parts for smaller in _cut(is_panel, part)]


def _runs_between(is_plain: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List the first row of each run between plain strips, and the row behind its last one.

    Thin strips separate no runs, but do not belong to the border of one.
    """
    runs = []
    start = None
    end = 0
    for row in np.flatnonzero(~is_plain).tolist():
        if start is None:
            start = row
        elif row - end >= _MIN_STRIP_PX:
            runs.append((start, end))
            start = row
        end = row + 1
    if start is not None:
        runs.append((start, end))
    return runs


def _without_frame(grey: Grey, piece: _Piece) -> _Piece:
    """Take the lines of a drawn frame from the border of a piece."""
    for _ in range(_MAX_FRAME_PX):
        pixels = piece.of(grey)
        piece = _Piece(
            piece.left + _line_px(pixels[:, 0]),
            piece.top + _line_px(pixels[0]),
            right=piece.right - _line_px(pixels[:, -1]),
            bottom=piece.bottom - _line_px(pixels[-1]),
        )
    return piece


def _line_px(values: NDArray[np.uint8]) -> int:
    """Return 1 for a row or column that hardly changes along itself, and 0 for another one."""
    steps = cv2.absdiff(values[1:], values[:-1])
    flat_share = (steps <= _FLAT_LEVELS).mean()
    return int(flat_share >= _PLAIN_SHARE)


def _flat_share(pixels: Grey) -> float:
    """Compute the share of pixels that differ neither from the one above nor from the left one."""
    across = cv2.absdiff(pixels[1:, 1:], pixels[1:, :-1])
    down = cv2.absdiff(pixels[1:, 1:], pixels[:-1, 1:])
    return float((cv2.max(across, down) <= _FLAT_LEVELS).mean())
