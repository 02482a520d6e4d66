"""Penalty areas of football pitches: straight lines at several ratios that the Laws of the Game fix."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise, product
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.courts.fit import AFFINE, SIMILARITY, Fit, fit, project
from vehanchor.courts.template import Line, Template
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window, tile_grid
from vehanchor.rulers.bay_lines import thin_lines
from vehanchor.rulers.standards import lengths_of
from vehanchor.rulers.turf import smooth_ground

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.rulers.bay_lines import Lines
    from vehanchor.scale.lengths import Interval

WIDTH_M, DEPTH_M, GOAL_WIDTH_M, GOAL_DEPTH_M = (
    lengths_of(f"football_{area}_area_{side}")[1][0].metres
    for area, side in product(("penalty", "goal"), ("width", "depth"))
)
_RADIUS_M = lengths_of("football_centre_circle")[1][0].metres / 2
_SPOT_M = 11.0  # from the goal line, IFAB law 1
_HALF_LINE_M = 0.06  # lines are up to 12 cm wide; areas are measured to their outside
_ARC_STEPS = 14
_SOUGHT_M_PER_PX, _FITTED_M_PER_PX = 0.15, 0.12  # resolutions of search and fit; pitches are laid out to some 0.1 m
_MOST_ZOOM = 2.0
_TILE_PX, _STRIDE_PX = 1536, 1024
_PAINT_M, _PAINT_PX = 0.3, 3.0  # widest line, blurred
_BRIGHTER_PX, _GAIN = 7, 4.0  # what is brighter than its surroundings of this size, and its amplification
_SHORTEST_M, _LONGEST_M = 3.0, 70.0
_DIRECTIONS, _APART_DEG, _ALONG_DEG = 3, 4, 2.0
_OFF = 0.012  # of the width: offset of a line from its place in the search
_LEAST_FRONT, _LEAST_FOUND = 0.3, 0.35  # shares of the front, and of all straight lines, in the search
_MOST_FITTED = 6
_LEAST_COVERAGE, _LEAST_LINE, _LEAST_ARC = 0.75, 0.5, 0.5
_MOST_DISTORTION = 0.015
_AROUND = 0.6  # of the diagonal: half side of the patch that is fitted
_NEAR = 0.3  # of the width: two finds are one


@dataclass(frozen=True, eq=False)
class PenaltyArea:
    """Penalty area with its goal area.

    Attributes:
        corners: ``[4, 2]`` outside the lines, pixels of the image; the first two bound the front.
        gsd_m_per_px: scale by all lines together.
        log_sd: standard deviation of its log, from the residuals.
        coverage: 0..1, share of the lines' length that was found.
    """

    corners: NDArray[np.float64]
    gsd_m_per_px: float
    log_sd: float
    coverage: float


class _Strokes(NamedTuple):
    """Lines of one direction: ``[n]`` offsets across it, and first and last place along it, pixels."""

    offset: NDArray[np.float64]
    first: NDArray[np.float64]
    last: NDArray[np.float64]

    def cover(self, at: NDArray[np.float64], start: float, stop: float, off: float) -> NDArray[np.float64]:
        """Compute the covered share ``[k]`` of segments between two places at each offset of ``[k]``."""
        overlap = np.maximum(np.minimum(self.last, stop) - np.maximum(self.first, start), 0.0)
        near = np.abs(self.offset - np.atleast_1d(at)[:, None]) <= off
        return np.asarray(np.minimum((near * overlap).sum(axis=1) / (stop - start), 1.0))


class _Guess(NamedTuple):
    """Place of an area: share of its lines that was found, and ``[3, 3]`` from metres to pixels."""

    share: float
    matrix: NDArray[np.float64]


def _template() -> Template:
    """Make the lines of a penalty area around its centre; x runs along the front, y towards the goal line."""
    x, y = WIDTH_M / 2 - _HALF_LINE_M, DEPTH_M / 2 - _HALF_LINE_M
    goal_x, goal_y = GOAL_WIDTH_M / 2 - _HALF_LINE_M, DEPTH_M / 2 - GOAL_DEPTH_M + _HALF_LINE_M
    lines = [Line(-x, -y, x, -y), Line(-x, y, -goal_x, y), Line(goal_x, y, x, y)]
    lines += [Line(side, -y, side, y) for side in (-x, x)]
    lines += [Line(-goal_x, goal_y, goal_x, goal_y), *(Line(side, goal_y, side, y) for side in (-goal_x, goal_x))]
    turn = math.acos((DEPTH_M - _SPOT_M) / _RADIUS_M)
    angles, reach = np.linspace(-turn, turn, _ARC_STEPS), _RADIUS_M - _HALF_LINE_M
    arc = np.stack([reach * np.sin(angles), DEPTH_M / 2 - _SPOT_M - reach * np.cos(angles)], axis=1)
    arcs = [Line(*map(float, (*start, *stop))) for start, stop in pairwise(arc)]
    return Template("penalty_area", WIDTH_M, DEPTH_M, tuple(lines), (), tuple(arcs))


_AREA = _template()


def find_penalty_areas(
    raster: Raster, scale: Interval, covers: Callable[[float, float], bool] | None = None
) -> list[PenaltyArea]:
    """Find penalty areas that lie completely in the image, with their goal area and arc, on smooth coloured ground.

    Args:
        raster: the image.
        scale: metres per pixel between which its scale lies.
        covers: whether to look around a place, x and y in pixels of the image; None looks everywhere.
    """
    middle = math.sqrt(scale.low * scale.high)
    factor = max(1, round(_SOUGHT_M_PER_PX / middle))
    zoom = min(max(middle * factor / _SOUGHT_M_PER_PX, 1.0), _MOST_ZOOM)
    found: list[PenaltyArea] = []
    size = raster.width_px // factor, raster.height_px // factor
    for window in tile_grid(*size, tile_px=round(_TILE_PX / zoom), stride_px=round(_STRIDE_PX / zoom)):
        middle_px = (window.x_px + window.width_px / 2) * factor, (window.y_px + window.height_px / 2) * factor
        if covers is not None and not covers(*middle_px):
            continue
        rgb = read_reduced_window(raster, window, factor)
        half = cv2.resize(rgb, (-(-window.width_px // 2), -(-window.height_px // 2)), interpolation=cv2.INTER_AREA)
        ground = smooth_ground(np.asarray(half, np.uint8), 2 * scale.high * factor)
        if not ground.any():
            continue
        grey = _enlarged(rgb, zoom)
        guesses = _guesses(grey, ground, scale.low * factor / zoom, scale.high * factor / zoom)
        for guess in sorted(guesses, key=lambda each: -each.share)[:_MOST_FITTED]:
            area = _fitted(raster, _placed(window, factor, zoom) @ guess.matrix, factor)
            if area is not None and not any(_same(area, other) for other in found):
                found.append(area)
    return found


def _enlarged(rgb: NDArray[np.uint8], zoom: float) -> NDArray[np.uint8]:
    """Compute grey levels, enlarged."""
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
    size = round(grey.shape[1] * zoom), round(grey.shape[0] * zoom)
    return grey if zoom == 1 else np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _placed(window: Window, factor: int, zoom: float) -> NDArray[np.float64]:
    """Build the matrix ``[3, 3]`` from pixels of an enlarged window to those of the image; 0 is a pixel's centre."""
    scale = factor / zoom
    x, y = (start * factor + scale / 2 - 0.5 for start in (window.x_px, window.y_px))
    return np.array([[scale, 0.0, x], [0.0, scale, y], [0.0, 0.0, 1.0]])


def _guesses(
    grey: NDArray[np.uint8], ground: NDArray[np.uint8], low_m_per_px: float, high_m_per_px: float
) -> list[_Guess]:
    """Guess areas by straight lines in two directions at right angles, distinct ones only.

    Args:
        grey: grey levels ``[h, w]``.
        ground: mask of the same extent at any resolution, 0 where no lines are sought.
        low_m_per_px: finest scale.
        high_m_per_px: coarsest scale.
    """
    middle = math.sqrt(low_m_per_px * high_m_per_px)
    widest = max(_PAINT_M / middle, _PAINT_PX)
    bright = cv2.morphologyEx(grey, cv2.MORPH_TOPHAT, np.ones((_BRIGHTER_PX, _BRIGHTER_PX), np.uint8))
    clear = np.asarray(cv2.convertScaleAbs(bright, alpha=_GAIN), np.uint8)
    clear[cv2.resize(ground, grey.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0] = 0
    lines = thin_lines(clear, widest, _SHORTEST_M / high_m_per_px, _LONGEST_M / low_m_per_px)
    if not len(lines.angles):
        return []
    kept: list[_Guess] = []
    found = [
        guess
        for angle in _directions(lines)
        for quarter in (0.0, math.pi / 2)
        for guess in _guesses_along(lines, angle + quarter, WIDTH_M / high_m_per_px, WIDTH_M / low_m_per_px)
    ]
    for one in sorted(found, key=lambda each: -each.share):
        near = _OFF * 2 * WIDTH_M * math.hypot(one.matrix[0, 0], one.matrix[1, 0])
        if not any(np.hypot(*(one.matrix - other.matrix)[:2, 2]) < near for other in kept):
            kept.append(one)
    return kept


def _directions(lines: Lines) -> list[float]:
    """List the commonest directions modulo a right angle, by the length of their lines, radians."""
    degrees = np.rad2deg(lines.angles) % 90
    bins = np.bincount(np.floor(degrees).astype(np.intp), lines.lengths, 90)
    smooth = bins + np.roll(bins, 1) + np.roll(bins, -1)
    found: list[float] = []
    for peak in np.argsort(-smooth, kind="stable").tolist():
        off = (degrees - peak - 0.5 + 45) % 90 - 45
        near = np.abs(off) <= _ALONG_DEG
        if len(found) == _DIRECTIONS or not near.any():
            break
        angle = peak + 0.5 + float(np.average(off[near], weights=lines.lengths[near] ** 2))
        if all(abs((angle - other + 45) % 90 - 45) > _APART_DEG for other in found):
            found.append(angle)
    return [math.radians(each) for each in found]


def _strokes(lines: Lines, angle: float) -> _Strokes:
    """Select the lines of one direction; offsets grow to the left of it, as y of a frame with x along it."""
    off = (lines.angles - angle + math.pi / 2) % math.pi - math.pi / 2
    (near,) = np.nonzero(np.abs(off) <= math.radians(_ALONG_DEG))
    along = np.array([math.cos(angle), math.sin(angle)])
    places = lines.centres[near]
    middle, half = places @ along, lines.lengths[near] / 2
    return _Strokes(places @ np.array([-along[1], along[0]]), middle - half, middle + half)


def _guesses_along(lines: Lines, angle: float, least_px: float, most_px: float) -> Iterator[_Guess]:
    """Yield areas whose front has a direction, from each pair of sides and each front between them."""
    fronts, across = _strokes(lines, angle), _strokes(lines, angle + math.pi / 2)
    sides = _Strokes(-across.offset, across.first, across.last)  # offsets along the front, places across it
    order = np.argsort(sides.offset, kind="stable")
    for index, one in enumerate(order[:-1]):
        rest = order[index + 1 :]
        width = sides.offset[rest] - sides.offset[one]
        beside = np.minimum(sides.last[rest], sides.last[one]) > np.maximum(sides.first[rest], sides.first[one])
        for other in rest[(width >= least_px) & (width <= most_px) & beside]:
            left, right = float(sides.offset[one]), float(sides.offset[other])
            yield from _guesses_between(fronts, sides, left, right, angle)


def _guesses_between(fronts: _Strokes, sides: _Strokes, left: float, right: float, angle: float) -> Iterator[_Guess]:
    """Yield areas between two sides, with the goal to either side of each front."""
    px_per_m, middle = (right - left) / (WIDTH_M - 2 * _HALF_LINE_M), (left + right) / 2
    off = max(_OFF * (right - left), 2.0)
    depth, goal_depth, goal = (each * px_per_m for each in (DEPTH_M, GOAL_DEPTH_M, GOAL_WIDTH_M / 2))
    shares = fronts.cover(fronts.offset, left, right, off)
    tried: list[float] = []
    for place in fronts.offset[np.argsort(-shares, kind="stable")][: int((shares >= _LEAST_FRONT).sum())].tolist():
        if any(abs(place - other) < off for other in tried):
            continue
        tried.append(place)
        for sign in (-1.0, 1.0):
            front, goal_front, back = place, place + sign * (depth - goal_depth), place + sign * depth
            along = (
                (front, left, right),
                (goal_front, middle - goal, middle + goal),
                (back, left, right),
            )
            covered = [fronts.cover(np.array([at]), start, stop, off)[0] * (stop - start) for at, start, stop in along]
            for start, at in ((front, (left, right)), (goal_front, (middle - goal, middle + goal))):
                low, high = sorted((start, back))
                covered += (sides.cover(np.array(at), low, high, off) * (high - low)).tolist()
            whole = sum(stop - start for _, start, stop in along) + 2 * (depth + goal_depth)
            if (share := sum(covered) / whole) >= _LEAST_FOUND:
                yield _Guess(share, _matrix(middle, (front + back) / 2, angle, sign, px_per_m))


def _matrix(along: float, across: float, angle: float, sign: float, px_per_m: float) -> NDArray[np.float64]:
    """Build the matrix from metres to pixels; a sign of -1 turns the area by half a turn."""
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = along * cos - across * sin, along * sin + across * cos
    scaled = sign * px_per_m
    return np.array([[cos * scaled, -sin * scaled, x], [sin * scaled, cos * scaled, y], [0.0, 0.0, 1.0]])


def _fitted(raster: Raster, matrix: NDArray[np.float64], factor: int) -> PenaltyArea | None:
    """Fit all lines together, at the resolution of the search and then finer; None if they do not support the area."""
    finest = max(1, round(_FITTED_M_PER_PX * math.hypot(matrix[0, 0], matrix[1, 0])))
    for each in (factor, finest):
        window = _around(raster, matrix, each)
        if window is None:
            return None
        grey = cv2.cvtColor(read_reduced_window(raster, window, each), cv2.COLOR_RGB2GRAY).astype(np.float32)
        placed = _placed(window, each, 1.0)
        seen = fit(grey, _AREA, np.linalg.inv(placed) @ matrix, SIMILARITY)
        matrix = placed @ seen.matrix
    if not _is_supported(seen) or fit(grey, _AREA, seen.matrix, AFFINE).distortion > _MOST_DISTORTION:
        return None
    corners = project(matrix, _AREA.outline)
    if (corners < 0).any() or (corners > (raster.width_px - 1, raster.height_px - 1)).any():
        return None
    return PenaltyArea(corners, 1.0 / math.hypot(matrix[0, 0], matrix[1, 0]), seen.log_sd, seen.coverage)


def _around(raster: Raster, matrix: NDArray[np.float64], factor: int) -> Window | None:
    """Lay a window of the image, reduced by ``factor``, around an area; None outside the image."""
    reach = _AROUND * math.hypot(WIDTH_M, DEPTH_M) * math.hypot(matrix[0, 0], matrix[1, 0])
    low = np.maximum((matrix[:2, 2] - reach) // factor, 0)
    high = np.minimum((matrix[:2, 2] + reach) // factor, (raster.width_px // factor, raster.height_px // factor))
    left, top, right, bottom = (int(value) for value in (*low, *high))
    return Window(left, top, right - left, bottom - top) if right > left and bottom > top else None


def _is_supported(seen: Fit) -> bool:
    """Test whether the front, both areas' sides, the goal area's front and the arc were found."""
    lines, arc = np.split(seen.line_coverage, [len(_AREA.lines)])
    front, goal_line, sides, goal_front, goal_sides = np.split(lines, [1, 3, 5, 6])
    return (
        math.isfinite(seen.log_sd)
        and seen.coverage >= _LEAST_COVERAGE
        and min(float(each.mean()) for each in (front, goal_line, sides, goal_front, goal_sides)) >= _LEAST_LINE
        and float(arc.mean()) >= _LEAST_ARC
    )


def _same(one: PenaltyArea, other: PenaltyArea) -> bool:
    apart = np.hypot(*(one.corners.mean(axis=0) - other.corners.mean(axis=0)))
    return bool(apart * other.gsd_m_per_px < _NEAR * WIDTH_M)
