"""Copies of one vehicle in an image: vehicles with equal pixels are one vehicle.

Someone pasted a car several times, or a program repeated a part of the picture. Copies add no
evidence, so the first one counts. Two real cars never have equal pixels, not even two of one model:
noise, shadows and their places between the pixels differ. Copies with other brightness or size are
found, too, if most vehicles are copies (``vehanchor.detection.altered_copies``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.detection.altered_copies import altered_copies
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

    Grey: TypeAlias = NDArray[np.float32]
    """``[side, side]``, or ``[n, side, side]``, grey values."""

# Numbers without a measurement beside them are choices.

# Root mean square difference over the spread of a vehicle's own pixels, below which two are copies.
# The most similar pair of each of 312 photographs has 0.24 and more. Copies of eight cars that were
# compressed again (JPEG quality 85) have less. A choice between both.
_MAX_DIFFERENCE = 0.16
# Vehicles with less contrast show nothing that could be compared.
_MIN_CONTRAST = 8.0
# Vehicles that are compared, best first, in an image in memory and in one that is read by windows.
_MAX_COMPARED = 400
_MAX_READ = 128
# Pixels of a body that are compared first, then those that tell the remaining pairs apart.
_SAMPLE_PIXELS = (24, 120)
# Two boxes of one copied vehicle differ by at most this much: in log length, angle, place and mean
# colour.
_MAX_LOG_LENGTH = 0.10
_MAX_TURN = 0.12
_SHIFT_PX = 3
_MAX_COLOUR = 12.0
# The part of a box that shows the vehicle alone, in lengths from its centre.
_HALF_LENGTH = 0.42
_HALF_WIDTH = 0.18


class _Body(NamedTuple):
    """Pixels of a vehicle's body, which are searched in the squares of others.

    Attributes:
        core: ``[side, side, 3]`` around the vehicle's centre.
        mask: ``[side, side]`` the pixels of the body.
        variance: mean variance of the three colours.
        max_squares: sum of squared differences up to which a square repeats the body. A part of the
            body has less.
    """

    core: Square
    mask: NDArray[np.bool_]
    variance: float
    max_squares: float

    @classmethod
    def of(cls, box: Box, square: Square, half: int) -> _Body:
        """Cut a body out of a square.

        Args:
            box: ``[5]``.
            square: ``[rows, columns, 3]`` around the vehicle.
            half: pixels from the centre to the sides of the core.
        """
        middle = len(square) // 2
        inner = slice(middle - half, middle + half + 1)
        core = square[inner, inner]
        mask = _mask(box, half)
        pixels = core[mask]
        variance = float(pixels.var(axis=0).mean())
        max_squares = pixels.size * _MAX_DIFFERENCE**2 * variance
        return cls(core, mask, variance, max_squares)


class _Sample(NamedTuple):
    """Some pixels of a vehicle's body, which are compared first: few suffice for most pairs.

    Attributes:
        x: ``[n]`` columns from the vehicle's centre.
        y: ``[n]`` rows from the vehicle's centre.
        greys: ``[n]`` grey values.
    """

    x: NDArray[np.intp]
    y: NDArray[np.intp]
    greys: NDArray[np.float32]


class _Picture:
    """Pixels of a vehicle; what only comparisons need is computed by the first of them.

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

    @cached_property
    def grey(self) -> Grey:
        """Grey values, whose squared differences are never more than those of the colours.

        The square of a sum of three differences is at most three times the sum of their squares.
        """
        red, green, blue = self.square.transpose(2, 0, 1)
        return np.asarray((red + green + blue) / np.float32(math.sqrt(3)))

    @cached_property
    def body(self) -> _Body:
        """The pixels of the body."""
        return _Body.of(self.box, self.square, _half_side(self.box[2]))

    @cached_property
    def samples(self) -> list[_Sample]:
        """Growing samples of the body.

        They lie inside the smallest square to which another vehicle may limit the body.
        """
        half = _half_side(self.box[2])
        least_half = _half_side(self.box[2] * math.exp(-_MAX_LOG_LENGTH)) + 1
        cut = max(0, half - least_half)
        mask = self.body.mask
        inner = mask[cut : len(mask) - cut, cut : len(mask) - cut]
        rows, columns = np.nonzero(inner)
        middle = len(self.square) // 2
        samples = []
        for n_pixels in _SAMPLE_PIXELS:
            step = max(1, len(rows) // n_pixels)
            y = rows[::step] + cut - half
            x = columns[::step] + cut - half
            samples.append(_Sample(x, y, self.grey[middle + y, middle + x]))
        return samples


class _Pictures:
    """Pictures of distinct vehicles, among which similar ones are found."""

    def __init__(self, most: int) -> None:
        """Begin without pictures.

        Args:
            most: largest number of pictures.
        """
        self._pictures: list[_Picture] = []
        self._log_lengths = np.empty(most)
        self._colours = np.empty((most, 3), np.float32)

    def add(self, picture: _Picture) -> None:
        """Add a picture."""
        n = len(self._pictures)
        self._log_lengths[n] = math.log(picture.box[2])
        self._colours[n] = picture.colour
        self._pictures.append(picture)

    def similar(self, picture: _Picture) -> list[_Picture]:
        """Select the pictures of vehicles with about the same length and colour."""
        n = len(self._pictures)
        log_ratios = self._log_lengths[:n] - math.log(picture.box[2])
        differences = np.abs(self._colours[:n] - picture.colour)
        is_similar = np.abs(log_ratios) <= _MAX_LOG_LENGTH
        is_similar &= differences.max(axis=1, initial=0) <= _MAX_COLOUR
        return [self._pictures[k] for k in np.flatnonzero(is_similar)]


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
    distinct = _Pictures(n_compared)
    is_copy = np.zeros(n_vehicles, np.bool_)
    places = []
    pictures = []
    for k, box in enumerate(detections.boxes[:n_compared]):
        picture = _picture(raster, box)
        if picture is None:
            continue
        if _is_copy(picture, distinct.similar(picture)):
            is_copy[k] = True
        else:
            distinct.add(picture)
            places.append(k)
            pictures.append(picture)
    distinct_vehicles = detections.take(~is_copy)
    # Copies with other brightness, direction or size.
    boxes = [picture.box for picture in pictures]
    squares = [picture.square for picture in pictures]
    is_altered = altered_copies(boxes, squares, n_exact=int(is_copy.sum()))
    is_copy[places] = is_altered
    if not is_copy.any():
        return detections
    with_copies = distinct_vehicles if is_altered.any() else None
    n_copies = int(is_copy.sum())
    return replace(detections.take(~is_copy), n_copies=n_copies, with_copies=with_copies)


def _picture(raster: Raster, box: Box) -> _Picture | None:
    """Read the pixels of a vehicle; None beside the border of the image."""
    half = _half_side(box[2]) + _SHIFT_PX + 1
    left = round(box[0]) - half
    top = round(box[1]) - half
    side = 2 * half + 1
    is_in_columns = 0 <= left <= raster.width_px - side
    is_in_rows = 0 <= top <= raster.height_px - side
    if not is_in_columns or not is_in_rows:
        return None
    window = Window(left, top, width_px=side, height_px=side)
    square = raster.read(window).astype(np.float32)
    return _Picture(box, square)


def _half_side(length: float) -> int:
    return math.ceil(_HALF_LENGTH * length)


class _Orientation(NamedTuple):
    """Orientation of a copy.

    Attributes:
        mirrored: whether left and right of the vehicle change places after the turn.
        quarter_turns: counterclockwise turns, which reduce an angle in pixels with y down.
    """

    mirrored: bool
    quarter_turns: int

    def angles_after(self, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute the angles ``[n]`` of boxes after turning and mirroring."""
        turned = angles - self.quarter_turns * math.pi / 2
        return -turned if self.mirrored else turned

    def square_after(self, square: Square) -> Square:
        """Turn and mirror a square."""
        turned = np.rot90(square, self.quarter_turns)
        return turned[:, ::-1] if self.mirrored else turned

    def places_before(
        self, x: NDArray[np.intp], y: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Find the places of pixels before turning and mirroring; all from the centre."""
        if self.mirrored:
            x = -x
        for _ in range(self.quarter_turns):
            turned_x = -y
            y = x
            x = turned_x
        return x, y


_ORIENTATIONS = [_Orientation(mirrored, turns) for mirrored in (False, True) for turns in range(4)]


def _is_copy(picture: _Picture, others: Sequence[_Picture]) -> bool:
    """Test whether a picture repeats one of the others, in any of eight orientations."""
    if not others:
        return False
    greys = _stacked([other.grey for other in others])
    angles = np.array([other.box[4] for other in others])
    for orientation in _ORIENTATIONS:
        # A box turned by half is the same box.
        turns = picture.box[4] - orientation.angles_after(angles) + math.pi / 2
        is_parallel = np.abs(turns % math.pi - math.pi / 2) <= _MAX_TURN
        if not is_parallel.any():
            continue
        rows = np.flatnonzero(is_parallel)
        # The sum over all pixels is never less than the sum over some.
        for sample in picture.samples:
            squares = _least_sample_squares(picture, sample, greys[rows], orientation)
            rows = rows[squares <= picture.body.max_squares]
            if not len(rows):
                break
        for k in rows.tolist():
            if _repeats(picture, orientation.square_after(others[k].square)):
                return True
    return False


def _stacked(squares: Sequence[Grey]) -> Grey:
    """Stack squares of several sizes ``[n, side, side]``, with black around the smaller ones."""
    side = max(map(len, squares))
    stack = np.zeros((len(squares), side, side), np.float32)
    for place, square in zip(stack, squares, strict=True):
        margin = (side - len(square)) // 2
        place[margin : side - margin, margin : side - margin] = square
    return stack


def _least_sample_squares(
    picture: _Picture, sample: _Sample, greys: Grey, orientation: _Orientation
) -> NDArray[np.float32]:
    """Sum the squared differences of some pixels, at the shift where the sum is least.

    Args:
        picture: the vehicle.
        sample: some of its pixels.
        greys: ``[n, side, side]`` grey values of others.
        orientation: of the vehicle as a copy of the others.

    Returns:
        ``[n]`` sums.
    """
    n_others, side, _ = greys.shape
    x, y = orientation.places_before(sample.x, sample.y)
    most_shift = _most_shift(picture, side)
    shifts = np.arange(-most_shift, most_shift + 1) + side // 2
    shifted = side * shifts[:, None] + shifts
    places = shifted.reshape(-1, 1) + (side * y + x)
    pixels = greys.reshape(n_others, -1).take(places, axis=1)
    difference = pixels - sample.greys
    squares = np.einsum("osn,osn->os", difference, difference)
    return np.asarray(squares.min(axis=1))


def _most_shift(picture: _Picture, side: int) -> int:
    """Return the pixels by which a vehicle's body can shift in a square."""
    return max(_SHIFT_PX, side // 2 - _half_side(picture.box[2]))


def _repeats(picture: _Picture, square: Square) -> bool:
    """Test whether a square shows a vehicle's body, at the best shift."""
    half = len(square) // 2 - _most_shift(picture, len(square))
    body = _Body.of(picture.box, picture.square, half)
    if body.variance < _MIN_CONTRAST**2:
        return False
    # One weight for each of the three colours of a pixel.
    weights = np.repeat(body.mask[:, :, None], 3, axis=2).astype(np.float32)
    turned = np.ascontiguousarray(square)
    squares = cv2.matchTemplate(turned, body.core, cv2.TM_SQDIFF, mask=weights)
    return float(squares.min()) <= body.max_squares


def _mask(box: Box, half: int) -> NDArray[np.bool_]:
    """Mark the pixels of a vehicle in the square around its centre."""
    x = np.arange(-half, half + 1)
    y = x[:, None]
    angle = box[4]
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    length = box[2]
    in_length = np.abs(along) <= _HALF_LENGTH * length
    in_width = np.abs(across) <= _HALF_WIDTH * length
    return np.asarray(in_length & in_width)
