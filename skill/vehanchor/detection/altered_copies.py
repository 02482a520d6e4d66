"""Copies of one vehicle with other brightness, contrast, direction or size.

Each vehicle is cut out along its own direction, and its grey values are compared without their
mean and spread. In an image of many cars, some pairs of real ones look as equal as copies do; but
where copies were pasted, most vehicles repeat another one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    Box: TypeAlias = NDArray[np.float64]
    """``[5]`` row ``(x, y, length, width, angle)``, pixels and radians."""

    Square: TypeAlias = NDArray[np.float32]
    """``[side, side, 3]`` RGB around a vehicle."""

    Body: TypeAlias = NDArray[np.float32]
    """``[336]`` grey values of a body, with mean 0 and length 1; all 0 without contrast."""

# Least correlation of a copy, and the share of vehicles that must repeat another one. In 28 images
# of a car that was pasted nine times with other brightness, contrast, direction, size, noise or
# compression, 27 have one to four distinct vehicles, where 3 to 24 were counted. None of 347
# photographs with two and more vehicles loses one. Chosen on 375 photographs, in part the same.
_MIN_CORRELATION = 0.98
_MIN_SHARE = 0.5
# Vehicles that decide whether copies were pasted, and others with which each one is compared.
_N_DECIDING = 12
_N_COMPARED = 3
_MIN_ROUGH_CORRELATION = 0.7
_MAX_LOG_LENGTH = 0.12
_MIN_CONTRAST = 6.0
# Columns and rows of a body, and the part of the box that it shows, in lengths.
_COLUMNS = 28
_ROWS = 12
_LENGTH = 0.84
_WIDTH = 0.36
# A vehicle can be turned by half and mirrored: signs along and across it.
_ORIENTATIONS = ((1, 1), (-1, 1), (1, -1), (-1, -1))
# Place of each pixel of a body: lengths along and across from its middle, and 1.
_ALONG, _ACROSS = np.meshgrid(
    _LENGTH * (np.arange(_COLUMNS) - (_COLUMNS - 1) / 2) / _COLUMNS,
    _WIDTH * (np.arange(_ROWS) - (_ROWS - 1) / 2) / _ROWS,
)
_PLACES = np.stack([_ALONG.ravel(), _ACROSS.ravel(), np.ones(_ROWS * _COLUMNS)])
# First steps of the alignment: of the place in lengths, the direction, and the size; each round
# halves them.
_PLACE_STEP = 0.03
_MIN_PLACE_STEP_PX = 1.0
_TURN_STEP = 0.05
_SIZE_STEP = 0.04
_ROUNDS = 4


class _Alignment(NamedTuple):
    """Correction of a box.

    Attributes:
        x: columns to shift its centre, pixels.
        y: rows to shift its centre, pixels.
        turn: radians to turn it.
        size: factor of its length.
    """

    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    size: float = 1.0


class _Vehicle:
    """Grey values of a vehicle.

    Attributes:
        log_length: log of the box's length.
        body: the body as the box shows it.
    """

    def __init__(self, box: Box, square: Square) -> None:
        """Keep the pixels.

        Args:
            box: ``[5]``.
            square: ``[side, side, 3]`` around the pixel nearest to the box's centre.
        """
        self._length = float(box[2])
        self._angle = float(box[4])
        self._grey = square.mean(axis=2)
        middle = len(square) // 2
        self._x = middle + float(box[0]) - round(box[0])
        self._y = middle + float(box[1]) - round(box[1])
        self.log_length = math.log(self._length)
        self.body = self.aligned(_Alignment(), (1, 1), min_contrast=_MIN_CONTRAST)

    def aligned(
        self, alignment: _Alignment, orientation: tuple[int, int], *, min_contrast: float = 0.0
    ) -> Body:
        """Cut out the body with a corrected box."""
        along, across = orientation
        length = self._length * alignment.size
        angle = self._angle + alignment.turn
        cosine = length * math.cos(angle)
        sine = length * math.sin(angle)
        # From lengths in the body to pixels of the square.
        to_square = np.array(
            [
                [along * cosine, -across * sine, self._x + alignment.x],
                [along * sine, across * cosine, self._y + alignment.y],
            ]
        )
        x, y = (to_square @ _PLACES).astype(np.float32).reshape(2, _ROWS, _COLUMNS)
        greys = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        deviations = np.asarray(greys, np.float32).ravel()
        deviations -= deviations.mean()
        size = math.sqrt(deviations @ deviations)
        if size <= min_contrast * math.sqrt(deviations.size):
            return np.zeros_like(deviations)
        return np.asarray(deviations / size, np.float32)

    def first_steps(self) -> _Alignment:
        """Choose the first steps of the alignment; the size is a difference here."""
        place = max(_MIN_PLACE_STEP_PX, _PLACE_STEP * self._length)
        return _Alignment(place, place, _TURN_STEP, _SIZE_STEP)


def altered_copies(boxes: Sequence[Box], squares: Sequence[Square]) -> NDArray[np.bool_]:
    """Mark vehicles that repeat a better one, if most vehicles do.

    Args:
        boxes: ``[5]`` box of each vehicle, best first.
        squares: ``[side, side, 3]`` pixels of each vehicle.

    Returns:
        ``[n]``; none is marked in an image in which only some vehicles look equal.
    """
    n = len(boxes)
    nothing = np.zeros(n, np.bool_)
    is_copy = nothing.copy()
    distinct: list[_Vehicle] = []
    for k, (box, square) in enumerate(zip(boxes, squares, strict=True)):
        # The first vehicles decide, then all; it ends when too few of them can still be copies.
        n_deciding = _N_DECIDING if k <= _N_DECIDING < n else n
        n_at_most = int(is_copy.sum()) + n_deciding - k
        if not _are_most(n_at_most, n_deciding):
            return nothing
        vehicle = _Vehicle(box, square)
        if not vehicle.body.any():
            continue
        if _repeats_one(vehicle, distinct):
            is_copy[k] = True
        else:
            distinct.append(vehicle)
    return is_copy if _are_most(int(is_copy.sum()), n) else nothing


def _are_most(n_copies: int, n: int) -> bool:
    """Test whether most of ``n`` vehicles behind the first one are copies."""
    return n > 1 and n_copies >= _MIN_SHARE * (n - 1)


def _repeats_one(vehicle: _Vehicle, others: Sequence[_Vehicle]) -> bool:
    """Test whether a vehicle repeats one of the others, in any of four orientations."""
    near = [other for other in others if _have_similar_lengths(vehicle, other)]
    if not near:
        return False
    rough = _rough_correlations(vehicle, near)
    candidates = np.flatnonzero(rough >= _MIN_ROUGH_CORRELATION)
    best_first = candidates[np.argsort(rough[candidates], kind="stable")[::-1]]
    for candidate in best_first[:_N_COMPARED]:
        k, number = divmod(int(candidate), len(_ORIENTATIONS))
        orientation = _ORIENTATIONS[number]
        if _is_alignable(vehicle, near[k], orientation, correlation=float(rough[candidate])):
            return True
    return False


def _have_similar_lengths(vehicle: _Vehicle, other: _Vehicle) -> bool:
    return abs(other.log_length - vehicle.log_length) <= _MAX_LOG_LENGTH


def _rough_correlations(vehicle: _Vehicle, others: Sequence[_Vehicle]) -> NDArray[np.float32]:
    """Correlate a vehicle with others as their boxes show them.

    Returns:
        ``[n * 4]``: the orientations of the first one, then those of the next one.
    """
    body = vehicle.body.reshape(_ROWS, _COLUMNS)
    # A body that is turned or mirrored has the same pixels in another order.
    turned = [body[::across, ::along].ravel() for along, across in _ORIENTATIONS]
    bodies = np.stack([other.body for other in others])
    return np.asarray(bodies @ np.stack(turned, axis=1), np.float32).ravel()


def _is_alignable(
    vehicle: _Vehicle, other: _Vehicle, orientation: tuple[int, int], correlation: float
) -> bool:
    """Test whether a vehicle equals another one after aligning their boxes, which differ slightly.

    Args:
        vehicle: the vehicle.
        other: another one, whose box is corrected.
        orientation: of the other one.
        correlation: of both without correction.
    """
    best = _Alignment()
    steps = other.first_steps()
    for _ in range(_ROUNDS):
        for field in _Alignment._fields:
            for direction in (-1, 1):
                if correlation >= _MIN_CORRELATION:
                    return True
                value = getattr(best, field) + direction * getattr(steps, field)
                trial = best._replace(**{field: value})
                body = other.aligned(trial, orientation)
                trial_correlation = float(body @ vehicle.body)
                if trial_correlation > correlation:
                    correlation = trial_correlation
                    best = trial
        steps = _Alignment(*(0.5 * step for step in steps))
    return correlation >= _MIN_CORRELATION
