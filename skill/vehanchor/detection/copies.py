"""Copies of one vehicle in an image: vehicles with equal pixels are one vehicle.

Someone pasted a car several times, or a program repeated a part of the picture. Copies add no
evidence, so the first one counts. Two real cars never have equal pixels, not even two of one model:
noise, shadows and their places between the pixels differ.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.raster import Raster

    Box: TypeAlias = NDArray[np.float64]
    """``[5]`` row ``(x, y, length, width, angle)``, pixels and radians."""

    Square: TypeAlias = NDArray[np.float32]
    """``[side, side, 3]`` RGB."""

# Root mean square difference over the spread of a vehicle's own pixels, below which two are copies.
# The most similar pair of each of 312 photographs has 0.24 and more. Copies of eight cars that were
# compressed again (JPEG quality 85) have less. A choice between both.
_MAX_DIFFERENCE = 0.16
# Vehicles with less contrast show nothing that could be compared.
_MIN_CONTRAST = 8.0
# Vehicles that are compared, best first, in an image in memory and in one that is read by windows.
_MAX_COMPARED = 400
_MAX_READ = 128
# Every third row and column is compared first: few pixels suffice to tell most pairs apart.
_SAMPLE_STEP = 3
# Two boxes of one copied vehicle differ by at most this much: in log length, angle, place and mean
# colour.
_MAX_LOG_LENGTH = 0.10
_MAX_TURN = 0.12
_SHIFT_PX = 3
_MAX_COLOUR = 12.0
# The part of a box that shows the vehicle alone, in lengths from its centre.
_HALF_LENGTH = 0.42
_HALF_WIDTH = 0.18


class _Template(NamedTuple):
    """Pixels of a vehicle's body, which are searched in the squares of others.

    Attributes:
        core: ``[side, side, 3]`` around the vehicle's centre.
        weights: ``[side, side, 3]``, 1 on the body and 0 beside it.
        sample: ``[n, 3]`` colours of some pixels of the body.
        sample_places: ``[n_shifts, n]`` places of these pixels among the pixels of another square,
            row by row, at each shift.
        max_squares: sum of squared differences up to which a square repeats the body.
    """

    core: Square
    weights: Square
    sample: NDArray[np.float32]
    sample_places: NDArray[np.intp]
    max_squares: float


class _Picture:
    """Pixels of a vehicle.

    Attributes:
        box: ``[5]``.
        square: ``[side, side, 3]`` around the box's centre, with room to shift.
        colour: ``[3]`` mean of the square.
    """

    def __init__(self, box: Box, square: Square) -> None:
        """Keep the pixels.

        Args:
            box: ``[5]``.
            square: ``[side, side, 3]`` around the box's centre, with room to shift.
        """
        self.box = box
        self.square = square
        self.colour: NDArray[np.float32] = square.mean(axis=(0, 1))
        self._templates: dict[int, _Template | None] = {}

    def template(self, side: int) -> _Template | None:
        """Cut out the vehicle's body, once for each size of the squares in which it is searched.

        Args:
            side: rows and columns of those squares.

        Returns:
            The template; None for a vehicle without contrast.
        """
        if side not in self._templates:
            self._templates[side] = _template(self.box, self.square, side)
        return self._templates[side]


def without_copies(raster: Raster, detections: Detections) -> Detections:
    """Leave out vehicles whose pixels repeat those of a better one, turned or mirrored, too.

    Args:
        raster: the image.
        detections: vehicles in pixels of the image, before the caller's corrections.

    Returns:
        The detections with ``n_copies``; the same ones without copies, and of a detector without a
        chip network, which may be meant for drawings.
    """
    if detections.appearance is None:
        return detections
    n_vehicles = len(detections.boxes)
    n_compared = _MAX_COMPARED if raster.in_memory else _MAX_READ
    distinct: list[_Picture] = []
    is_copy = np.zeros(n_vehicles, np.bool_)
    for k, box in enumerate(detections.boxes[:n_compared]):
        picture = _picture(raster, box)
        if picture is None:
            continue
        if any(_is_copy(picture, other) for other in _similar(picture, distinct)):
            is_copy[k] = True
        else:
            distinct.append(picture)
    if not is_copy.any():
        return detections
    return replace(detections.take(~is_copy), n_copies=int(is_copy.sum()))


def _picture(raster: Raster, box: Box) -> _Picture | None:
    """Read the pixels of a vehicle; None beside the border of the image."""
    half = _half_side(box) + _SHIFT_PX + 1
    left = round(box[0]) - half
    top = round(box[1]) - half
    side = 2 * half + 1
    if left < 0 or top < 0 or left + side > raster.width_px or top + side > raster.height_px:
        return None
    window = Window(left, top, width_px=side, height_px=side)
    square = raster.read(window).astype(np.float32)
    return _Picture(box, square)


def _half_side(box: Box) -> int:
    return math.ceil(_HALF_LENGTH * float(box[2]))


def _similar(picture: _Picture, others: Sequence[_Picture]) -> list[_Picture]:
    """Select the pictures of vehicles with about the same length and colour."""
    similar = []
    for other in others:
        if abs(math.log(picture.box[2] / other.box[2])) > _MAX_LOG_LENGTH:
            continue
        if np.abs(picture.colour - other.colour).max() <= _MAX_COLOUR:
            similar.append(other)
    return similar


def _is_copy(picture: _Picture, other: _Picture) -> bool:
    """Test whether a picture repeats another one, in any of eight orientations."""
    for mirrored in (False, True):
        for quarter_turns in range(4):
            if not _has_angle(picture.box, other.box, mirrored, quarter_turns):
                continue
            square = np.rot90(other.square, quarter_turns)
            if mirrored:
                square = square[:, ::-1]
            if _repeats(picture, square):
                return True
    return False


def _has_angle(box: Box, other: Box, mirrored: bool, quarter_turns: int) -> bool:
    """Test whether another box has this box's angle after turning and mirroring.

    Args:
        box: ``[5]``.
        other: ``[5]``.
        mirrored: whether left and right of the other change places after the turn.
        quarter_turns: counterclockwise turns, which reduce an angle in pixels with y down.
    """
    angle = other[4] - quarter_turns * math.pi / 2
    if mirrored:
        angle = -angle
    # A box turned by half is the same box.
    turn = float(box[4] - angle + math.pi / 2) % math.pi - math.pi / 2
    return abs(turn) <= _MAX_TURN


def _repeats(picture: _Picture, square: Square) -> bool:
    """Test whether a square shows a vehicle's body, at the best shift."""
    template = picture.template(len(square))
    if template is None:
        return False
    square = np.ascontiguousarray(square)
    # The sum over all pixels is never less than the sum over some.
    if _least_sample_squares(template, square) > template.max_squares:
        return False
    squares = cv2.matchTemplate(square, template.core, cv2.TM_SQDIFF, mask=template.weights)
    return float(squares.min()) <= template.max_squares


def _least_sample_squares(template: _Template, square: Square) -> float:
    """Sum the squared differences of some pixels, at the shift where the sum is least."""
    colours = square.reshape(-1, 3).take(template.sample_places, axis=0)
    difference = colours - template.sample
    squares = np.einsum("snc,snc->s", difference, difference)
    return float(squares.min())


def _template(box: Box, square: Square, side: int) -> _Template | None:
    """Cut a vehicle's body out of its square, to search it in squares of one size.

    Args:
        box: ``[5]``.
        square: ``[rows, columns, 3]`` around the vehicle.
        side: rows and columns of the squares in which it is searched.

    Returns:
        The template; None for a vehicle without contrast.
    """
    half = min(_half_side(box), side // 2 - _SHIFT_PX)
    middle = len(square) // 2
    core = square[middle - half : middle + half + 1, middle - half : middle + half + 1]
    body = _body(box, half)
    contrast = math.sqrt(float(core[body].var(axis=0).mean()))
    if contrast < _MIN_CONTRAST:
        return None
    weights = np.repeat(body[:, :, None], 3, axis=2).astype(np.float32)
    max_squares = float(weights.sum()) * (_MAX_DIFFERENCE * contrast) ** 2

    rows, columns = _SAMPLE_STEP * np.argwhere(body[::_SAMPLE_STEP, ::_SAMPLE_STEP]).T
    n_shifts = side - len(core) + 1
    first_places = np.arange(n_shifts)[:, None] * side + np.arange(n_shifts)
    places = first_places.reshape(-1, 1) + (rows * side + columns)
    return _Template(core, weights, core[rows, columns], places, max_squares)


def _body(box: Box, half: int) -> NDArray[np.bool_]:
    """Mark the pixels of a vehicle in the square around its centre."""
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    angle = box[4]
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    length = box[2]
    in_length = np.abs(along) <= _HALF_LENGTH * length
    in_width = np.abs(across) <= _HALF_WIDTH * length
    return np.asarray(in_length & in_width)
