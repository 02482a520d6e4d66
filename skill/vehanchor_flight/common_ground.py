"""Ground that several photographs show: their pictures of it are one witness.

A car that stands on ground of five photographs is found up to five times. These are not five cars,
and their boxes have common errors: the same shade, the same paint, the same neighbour. Therefore
the vehicles of a flight are counted by the ground:

* Each photograph has a placement in the frame of its ground, from the overlaps.
* Boxes of several photographs at one place are one car (``distinct_vehicles``).
* Of any ground, no more cars count than the photograph with the strongest vehicles shows. A car
  that drives is at another place in each photograph, and counts once, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.detection.detections import Detections
from vehanchor.scale.lengths import GROUP_LOG_REACH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.photograph import Photograph

    Points: TypeAlias = NDArray[np.complex128]
    """Points ``[n]`` as complex numbers: x is the real part, y down is the imaginary part."""

    Lengths: TypeAlias = NDArray[np.float64]
    """Lengths ``[n]`` of boxes in the frame of their ground."""

    Counts: TypeAlias = NDArray[np.float64]
    """Numbers ``[n]`` of photographs or of cars."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the points or boxes ``[n]`` have a property."""

    Indices: TypeAlias = NDArray[np.intp]
    """Indices ``[n]`` of photographs or of cars."""

# Two boxes with centres closer than this are one car; in lengths of the shorter box. Cars that park
# side by side are half a length apart. A choice.
_SAME_PLACE = 0.4
# Points across and down a photograph at which its common ground is counted. A choice.
_GRID = 8


@dataclass(frozen=True, eq=False)
class Placement:
    """Position of a photograph in the frame of its ground.

    Attributes:
        ground: number of the ground; photographs of different numbers show different ground.
        factor: complex number that turns and scales pixels of the photograph to those of the frame.
        shift: the frame's point of the photograph's pixel 0, 0.
        corners: ``[4]`` corners of the photograph, in its own pixels as seen from above, in order.
    """

    ground: int
    factor: complex
    shift: complex
    corners: Points

    def in_frame(self, points: Points) -> Points:
        """Convert points ``[n]`` in pixels of the photograph to the frame."""
        return np.asarray(self.factor * points + self.shift)

    def shows(self, points: Points) -> Flags:
        """Find which points ``[n]`` of the frame are in the photograph."""
        own = (points - self.shift) / self.factor
        starts = self.corners[:, None]
        edges = np.roll(self.corners, -1)[:, None] - starts
        # The cross product of an edge with the way to a point has one sign for all four edges.
        sides = (np.conj(edges) * (own - starts)).imag
        is_right = (sides >= 0).all(axis=0)
        is_left = (sides <= 0).all(axis=0)
        return np.asarray(is_right | is_left)


def seen_from_above(photograph: Photograph, points: NDArray[np.float64]) -> Points:
    """Convert pixels ``[n, 2]`` of a photograph to those of a nadir view, as complex numbers."""
    plane = photograph.view.plane
    if plane is not None:
        points = plane.from_above(points) + photograph.centre_px
    return np.asarray(points[:, 0] + 1j * points[:, 1])


def corners_from_above(photograph: Photograph) -> Points:
    """Find the corners ``[4]`` of a photograph in its pixels as seen from above."""
    image = photograph.view.image
    width = float(image.width_px)
    height = float(image.height_px)
    x = [0.0, width, width, 0.0]
    y = [0.0, 0.0, height, height]
    corners = np.column_stack([x, y])
    return seen_from_above(photograph, corners)


def n_distinct(placements: Sequence[Placement]) -> float:
    """Compute how many photographs without common ground show as much as these.

    Args:
        placements: of the photographs.

    Returns:
        1 for pictures of the same ground, and the number of the photographs if none overlap.
    """
    shares = (np.arange(_GRID) + 0.5) / _GRID
    across, down = np.meshgrid(shares, shares)
    total = 0.0
    for placement in placements:
        first, second, third, fourth = placement.corners
        top = first + across * (second - first)
        bottom = fourth + across * (third - fourth)
        own = top + down * (bottom - top)
        points = placement.in_frame(own.ravel())
        n_showing = _n_showing(points, placement.ground, placements)
        total += float(np.mean(1.0 / n_showing))
    return total


def _n_showing(points: Points, ground: int, placements: Sequence[Placement]) -> Counts:
    """Count the photographs that show each of the points ``[n]`` of a ground; at least one."""
    counts = np.zeros(len(points))
    for placement in placements:
        if placement.ground == ground:
            counts += placement.shows(points)
    return np.maximum(counts, 1.0)


class _Boxes(NamedTuple):
    """Boxes of several photographs of one ground.

    Attributes:
        members: ``[n]`` index of each box's photograph.
        rows: ``[n]`` row of each box in the detections of its photograph.
        centres: ``[n]`` in the frame of the ground.
        lengths: ``[n]`` in pixels of the frame.
        scores: ``[n]`` detection scores.
        shares: ``[n]`` one over the number of photographs that show its place.
        on_new_ground: ``[n]`` whether no photograph with stronger vehicles shows its place.
    """

    members: Indices
    rows: Indices
    centres: Points
    lengths: Lengths
    scores: Counts
    shares: Counts
    on_new_ground: Flags


class _Car(NamedTuple):
    """Boxes at one place.

    Attributes:
        share: number of photographs that found it, over those that show its place.
        score: mean score of its boxes.
        box: index of the box of median length.
    """

    share: float
    score: float
    box: int


def distinct_vehicles(
    members: Sequence[Photograph], placements: Sequence[Placement]
) -> list[Detections]:
    """Keep one box of each car that several photographs show.

    Args:
        members: the photographs.
        placements: of the photographs.

    Returns:
        The rectified detections of each photograph, with those boxes only that represent a car: of
        the boxes of one car that of median length, with the mean of their scores.
    """
    detections = [member.rectified_detections for member in members]
    kept = [np.zeros(len(part.boxes), dtype=bool) for part in detections]
    scores = [part.scores.copy() for part in detections]
    for ground in sorted({placement.ground for placement in placements}):
        boxes = _boxes_of(ground, members, placements)
        for car in _cars(boxes):
            member = boxes.members[car.box]
            row = boxes.rows[car.box]
            kept[member][row] = True
            scores[member][row] = car.score
    return [
        replace(part, scores=own_scores).take(own_kept)
        for part, own_kept, own_scores in zip(detections, kept, scores, strict=True)
    ]


def _boxes_of(
    ground: int, members: Sequence[Photograph], placements: Sequence[Placement]
) -> _Boxes:
    """Collect the boxes of all photographs of a ground, the strongest photograph first."""
    indices = [k for k, placement in enumerate(placements) if placement.ground == ground]

    def strength(member: int) -> float:
        return _strength(members[member])

    # A reversed sort keeps the order of equals, too.
    indices.sort(key=strength, reverse=True)
    parts = []
    stronger: list[Placement] = []
    for member in indices:
        detections = members[member].rectified_detections
        placement = placements[member]
        n_boxes = len(detections.boxes)
        own_centres = seen_from_above(members[member], detections.boxes[:, :2])
        centres = placement.in_frame(own_centres)
        part = _Boxes(
            members=np.full(n_boxes, member),
            rows=np.arange(n_boxes),
            centres=centres,
            lengths=detections.boxes[:, 2] * abs(placement.factor),
            scores=detections.scores,
            shares=1.0 / _n_showing(centres, ground, placements),
            on_new_ground=~_is_shown(centres, stronger),
        )
        parts.append(part)
        stronger.append(placement)
    columns = zip(*parts, strict=True)
    return _Boxes(*(np.concatenate(column) for column in columns))


def _strength(photograph: Photograph) -> float:
    """Measure the evidence of a photograph's own vehicles, which few good ones raise most."""
    scores = photograph.rectified_detections.scores
    return float((scores**2).sum())


def _is_shown(points: Points, placements: Sequence[Placement]) -> Flags:
    """Find which points ``[n]`` of a ground are in any of these photographs."""
    is_shown = np.zeros(len(points), dtype=bool)
    for placement in placements:
        is_shown |= placement.shows(points)
    return is_shown


def _cars(boxes: _Boxes) -> list[_Car]:
    """List the cars of a ground, as many as the strongest photographs of its parts show."""
    numbers = _same_car(boxes)
    cars = []
    n_numbers = int(numbers.max(initial=-1)) + 1
    for number in range(n_numbers):
        own = np.flatnonzero(numbers == number)
        order = np.argsort(boxes.lengths[own], kind="stable")
        by_length = own[order]
        car = _Car(
            share=float(boxes.shares[own].sum()),
            score=float(boxes.scores[own].mean()),
            box=int(by_length[len(own) // 2]),
        )
        cars.append(car)
    # Cars that drive, and false alarms, are found in few of the photographs of their place.
    cars.sort(key=_most_often_first)
    n_cars = int(boxes.on_new_ground.sum())
    return cars[:n_cars]


def _most_often_first(car: _Car) -> tuple[float, float]:
    return -round(car.share, 6), -car.score


def _same_car(boxes: _Boxes) -> Indices:
    """Number the cars: boxes of several photographs at one place have one number, ``[n]``."""
    n_boxes = len(boxes.centres)
    numbers = np.full(n_boxes, -1)
    # Boxes in order of x, so that those near a place are a slice.
    x = boxes.centres.real
    by_x = np.argsort(x, kind="stable")
    reaches = _SAME_PLACE * boxes.lengths
    starts = np.searchsorted(x[by_x], x - reaches, side="left")
    ends = np.searchsorted(x[by_x], x + reaches, side="right")
    photographs_of: list[set[int]] = []
    for box in range(n_boxes):
        near = by_x[starts[box] : ends[box]]
        member = int(boxes.members[box])
        earlier = near[near < box]
        same = _same_place(boxes, box, earlier)
        for number in numbers[same].tolist():
            # A photograph finds a car once.
            if member not in photographs_of[number]:
                numbers[box] = number
                break
        else:
            numbers[box] = len(photographs_of)
            photographs_of.append(set())
        photographs_of[numbers[box]].add(member)
    return numbers


def _same_place(boxes: _Boxes, box: int, others: Indices) -> Indices:
    """Select the boxes at the place of a box and of about its size, the nearest first."""
    length = boxes.lengths[box]
    lengths = boxes.lengths[others]
    distances = np.abs(boxes.centres[others] - boxes.centres[box])
    shorter = np.minimum(lengths, length)
    log_ratios = np.log(lengths / length)
    is_near = distances <= _SAME_PLACE * shorter
    is_alike = np.abs(log_ratios) <= GROUP_LOG_REACH
    is_same = is_near & is_alike
    order = np.argsort(distances[is_same], kind="stable")
    return np.asarray(others[is_same][order])
