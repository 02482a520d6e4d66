"""Copies of one vehicle with other brightness, contrast, direction or size.

Each vehicle is cut out along its own direction, and its grey values are compared without their
mean and spread. In an image of many cars, some pairs of real ones look as equal as copies do; but
where copies were pasted, most vehicles repeat another one.
"""

from __future__ import annotations

import math
from functools import cached_property
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

    Bodies: TypeAlias = NDArray[np.float32]
    """``[n, 336]``, one body in each row."""

# Numbers without a measurement beside them are choices.

# Least correlation of a copy, and the share of vehicles that must repeat another one. Of 80 images
# in which real cars were pasted in 20 ways, 70 count no more cars than were pasted; in the others
# most are false alarms. Of 1,086 photographs with two and more vehicles one loses a vehicle.
_MIN_CORRELATION = 0.98
_MIN_SHARE = 0.5
# Where most are copies, the others need less: of 564 vehicles of 150 photographs a tenth is as
# similar to another one of its photograph.
_MIN_CORRELATION_AMONG_COPIES = 0.93
# Vehicles that decide whether copies were pasted, and others with which each one is compared.
_N_DECIDING = 12
_N_COMPARED = 3
_MIN_ROUGH_CORRELATION = 0.7
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
    """Correction of a box; starts of an alignment have ``x`` and ``y`` in lengths of the box.

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


class _Reach(NamedTuple):
    """How far the boxes of two copies may differ.

    Attributes:
        starts: corrections from which the alignment begins.
        max_log_length: largest difference of their log lengths.
        min_correlation: least correlation of a copy.
    """

    starts: tuple[_Alignment, ...]
    max_log_length: float
    min_correlation: float


# Many vehicles are compared with nearly the same boxes only. Boxes of a small copy on other ground
# differ by up to a third in length and by a tenth of it in place; few vehicles are compared so.
_NARROW = _Reach((_Alignment(),), max_log_length=0.12, min_correlation=_MIN_CORRELATION)
_WIDE = _Reach(
    tuple(
        _Alignment(x, y, size=size)
        for size in (0.8, 0.9, 1.0, 1.11, 1.25)
        for x in (-0.08, 0.0, 0.08)
        for y in (-0.08, 0.0, 0.08)
    ),
    max_log_length=0.4,
    min_correlation=_MIN_CORRELATION,
)
_WHERE_MOST_ARE_COPIES = _WIDE._replace(min_correlation=_MIN_CORRELATION_AMONG_COPIES)


class _Vehicle:
    """Grey values of a vehicle.

    Attributes:
        log_length: log of the box's length.
        body: the body as the box shows it.
    """

    def __init__(self, box: Box, square: Square, starts: tuple[_Alignment, ...]) -> None:
        """Keep the pixels.

        Args:
            box: ``[5]``.
            square: ``[side, side, 3]`` around the pixel nearest to the box's centre.
            starts: corrections of the box from which an alignment begins.
        """
        self._starts = starts
        self._length = float(box[2])
        self._angle = float(box[4])
        self._grey = square.mean(axis=2)
        middle = len(square) // 2
        self._x = middle + float(box[0]) - round(box[0])
        self._y = middle + float(box[1]) - round(box[1])
        self.log_length = math.log(self._length)
        (self.body,) = self.aligned([_Alignment()], (1, 1), min_contrast=_MIN_CONTRAST)

    @cached_property
    def starts(self) -> list[_Alignment]:
        """Corrections from which an alignment with another vehicle begins."""
        starts = []
        for start in self._starts:
            x = start.x * self._length
            y = start.y * self._length
            starts.append(start._replace(x=x, y=y))
        return starts

    @cached_property
    def bodies(self) -> Bodies:
        """The body at each start."""
        return self.aligned(self.starts, (1, 1))

    def aligned(
        self,
        alignments: Sequence[_Alignment],
        orientation: tuple[int, int],
        *,
        min_contrast: float = 0.0,
    ) -> Bodies:
        """Cut out the body with a corrected box, for each of several corrections."""
        along, across = orientation
        # From lengths in the body to pixels of the square.
        to_square = np.empty((len(alignments), 2, 3))
        for matrix, alignment in zip(to_square, alignments, strict=True):
            length = self._length * alignment.size
            angle = self._angle + alignment.turn
            cosine = length * math.cos(angle)
            sine = length * math.sin(angle)
            matrix[0] = along * cosine, -across * sine, self._x + alignment.x
            matrix[1] = along * sine, across * cosine, self._y + alignment.y
        places = (to_square @ _PLACES).astype(np.float32)
        x, y = places.transpose(1, 0, 2).reshape(2, -1, _COLUMNS)
        greys = cv2.remap(self._grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        bodies = np.asarray(greys, np.float32).reshape(len(alignments), -1)
        bodies -= bodies.mean(axis=1, keepdims=True)
        least_size = min_contrast * math.sqrt(bodies.shape[1])
        for body in bodies:
            size = math.sqrt(body @ body)
            body[:] = 0.0 if size <= least_size else body / size
        return bodies

    def first_steps(self) -> _Alignment:
        """Choose the first steps of the alignment; the size is a difference here."""
        place = max(_MIN_PLACE_STEP_PX, _PLACE_STEP * self._length)
        return _Alignment(place, place, _TURN_STEP, _SIZE_STEP)


def altered_copies(
    boxes: Sequence[Box], squares: Sequence[Square], n_exact: int = 0
) -> NDArray[np.bool_]:
    """Mark vehicles that repeat a better one, if most vehicles do.

    Args:
        boxes: ``[5]`` box of each vehicle, best first.
        squares: ``[side, side, 3]`` pixels of each vehicle.
        n_exact: exact copies of them, which are left out already.

    Returns:
        ``[n]``; none is marked in an image in which only some vehicles look equal.
    """
    is_copy = np.zeros(len(boxes), np.bool_)
    if len(boxes) > _N_DECIDING:
        is_copy = _copies(boxes, squares, _NARROW)
    if len(boxes) - int(is_copy.sum()) > _N_DECIDING:
        return is_copy
    # A few boxes are compared more widely.
    for reach in (_WIDE, _WHERE_MOST_ARE_COPIES):
        n_earlier = n_exact + int(is_copy.sum())
        remaining = np.flatnonzero(~is_copy).tolist()
        is_copy[remaining] = _copies(
            [boxes[k] for k in remaining],
            [squares[k] for k in remaining],
            reach,
            n_earlier=n_earlier,
        )
        n_copies = n_exact + int(is_copy.sum())
        if not _are_most(n_copies, n_exact + len(boxes)):
            break
    return is_copy


def _copies(
    boxes: Sequence[Box], squares: Sequence[Square], reach: _Reach, n_earlier: int = 0
) -> NDArray[np.bool_]:
    """Mark copies, if these and the earlier ones are most vehicles.

    Args:
        boxes: ``[5]`` box of each vehicle, best first.
        squares: ``[side, side, 3]`` pixels of each vehicle.
        reach: how far boxes of copies may differ.
        n_earlier: copies that were found before and are left out.

    Returns:
        ``[n]``.
    """
    n = len(boxes)
    nothing = np.zeros(n, np.bool_)
    is_copy = nothing.copy()
    distinct: list[_Vehicle] = []
    for k, (box, square) in enumerate(zip(boxes, squares, strict=True)):
        # The first vehicles decide, then all; it ends when too few of them can still be copies.
        n_deciding = _N_DECIDING if k <= _N_DECIDING < n else n
        n_at_most = n_earlier + int(is_copy.sum()) + n_deciding - k
        if not _are_most(n_at_most, n_earlier + n_deciding):
            return nothing
        vehicle = _Vehicle(box, square, reach.starts)
        if not vehicle.body.any():
            continue
        if _repeats_one(vehicle, distinct, reach):
            is_copy[k] = True
        else:
            distinct.append(vehicle)
    n_copies = n_earlier + int(is_copy.sum())
    return is_copy if _are_most(n_copies, n_earlier + n) else nothing


def _are_most(n_copies: int, n: int) -> bool:
    """Test whether most of ``n`` vehicles behind the first one are copies."""
    return n > 1 and n_copies >= _MIN_SHARE * (n - 1)


def _repeats_one(vehicle: _Vehicle, others: Sequence[_Vehicle], reach: _Reach) -> bool:
    """Test whether a vehicle repeats one of the others, in any of four orientations."""
    near = [
        other
        for other in others
        if abs(other.log_length - vehicle.log_length) <= reach.max_log_length
    ]
    if not near:
        return False
    by_start = _rough_correlations(vehicle, near)
    best_starts = by_start.argmax(axis=1)
    rough = by_start.max(axis=1).ravel()
    candidates = np.flatnonzero(rough >= _MIN_ROUGH_CORRELATION)
    best_first = candidates[np.argsort(rough[candidates], kind="stable")[::-1]]
    for candidate in best_first[:_N_COMPARED]:
        k, number = divmod(int(candidate), len(_ORIENTATIONS))
        if _is_alignable(
            vehicle,
            near[k],
            _ORIENTATIONS[number],
            start=near[k].starts[best_starts[k, number]],
            correlation=float(rough[candidate]),
            min_correlation=reach.min_correlation,
        ):
            return True
    return False


def _rough_correlations(vehicle: _Vehicle, others: Sequence[_Vehicle]) -> NDArray[np.float32]:
    """Correlate a vehicle with others at their starts.

    Returns:
        ``[n, starts, 4]`` of each other one, start and orientation.
    """
    body = vehicle.body.reshape(_ROWS, _COLUMNS)
    # A body that is turned or mirrored has the same pixels in another order.
    turned = [body[::across, ::along].ravel() for along, across in _ORIENTATIONS]
    bodies = np.stack([other.bodies for other in others])
    return np.asarray(bodies @ np.stack(turned, axis=1), np.float32)


def _is_alignable(
    vehicle: _Vehicle,
    other: _Vehicle,
    orientation: tuple[int, int],
    start: _Alignment,
    correlation: float,
    min_correlation: float,
) -> bool:
    """Test whether a vehicle equals another one after aligning their boxes, which differ slightly.

    Args:
        vehicle: the vehicle.
        other: another one, whose box is corrected.
        orientation: of the other one.
        start: correction from which the alignment begins.
        correlation: of both at the start.
        min_correlation: least correlation of a copy.
    """
    best = start
    steps = other.first_steps()
    for _ in range(_ROUNDS):
        for field in _Alignment._fields:
            if correlation >= min_correlation:
                return True
            value = getattr(best, field)
            step = getattr(steps, field)
            trials = [
                best._replace(**{field: value - step}),
                best._replace(**{field: value + step}),
            ]
            for trial, body in zip(trials, other.aligned(trials, orientation), strict=True):
                trial_correlation = float(body @ vehicle.body)
                if trial_correlation > correlation:
                    correlation = trial_correlation
                    best = trial
                    break
        steps = _Alignment(*(0.5 * step for step in steps))
    return correlation >= min_correlation
