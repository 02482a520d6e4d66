"""Rows of parking bays: painted lines side by side at one pitch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.tiles import read_reduced_window, tile_grid
from vehanchor.rulers.bay_lines import Lines, neighbours, thin_lines

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.scale.lengths import Interval

_PITCH_M = (2.1, 3.1)  # of bays, perpendicular to their lines
_LINE_M = (3.2, 12.5)  # of one row, or of two rows head to head
_PAINT_M = 0.45  # widest line, blurred
_PAINT_PX = 2.5  # widest line at a low resolution
_LEAST_PITCH_PX, _MOST_PITCH_PX = 16.0, 28.0  # at which lines are sought
_TILE_PX, _STRIDE_PX = 1024, 896
_CELL_PX, _CELL_STEP_PX = 96, 64  # of the windows whose spectra are compared
_BRIGHTER_PX, _BRIGHTEST = 5, 40  # what is brighter than its surroundings of this size, in grey levels
_LEAST_BRIGHT = 1.0  # mean of a window's brighter parts, in grey levels; in others there is no paint
_LEAST_STRIPED = 0.025  # share of a window's power at one wavelength of the pitch
_MOST_CELLS, _MOST_SHARE = (
    6,
    0.06,
)  # of a tile's windows that are looked at closely: so many, or this share of an unreduced tile
_AROUND_PX = 24  # beside such a window
_GRID_PX = 8  # of the mask: it divides the three sizes above
_DARKEST, _PALEST = 30, 200  # grey levels of asphalt and concrete; between bars it is darker, roofs are brighter
_COLOURED = 45  # difference of the channels: grass, brick, water
_RATIOS = ((1.4, 2.5), (3.3, 4.7))  # of a line's length to the pitch: one row, two rows
_INSIDE = np.array([-0.3, -0.15, 0.0, 0.15, 0.3])  # of a line's length from its middle: where levels are compared
_BEYOND = np.array([0.35, 0.6, 0.85])  # of the pitch beyond a line's end
_ALIKE = 20  # grey levels by which the same ground differs
_PAINT = (8, 120)  # grey levels by which paint is brighter
_LEAST_BARE, _LEAST_OPEN = 0.5, 0.65  # shares of the same ground in the bays and in the aisle
_LEAST_LINES = 6
_MOST_GAP = 2  # pitches between neighbouring lines of a row: a car hides a line
_LEAST_FILL = 0.7  # share of the row's lines that are seen
_PARALLEL_RAD = math.radians(4)
_AS_LONG = 0.5  # largest log ratio of two lines' lengths
_OFF_PITCH, _DRIFT = 0.12, 0.012  # of the pitch: a line's largest offset, and its growth with each pitch
_OFF_ALONG = 0.25  # of the length: a line's largest shift along itself
_STEEPEST = 1.1  # shift of neighbouring lines along themselves, over their pitch: slanted bays
_MOST_RMS = 0.06  # of the pitch


@dataclass(frozen=True, eq=False)
class BayRow:
    """Row of bays.

    Attributes:
        ends: ``[n, 2, 2]`` ends of its lines, pixels of the image; 0 is the centre of the first pixel.
        pitch_px: distance between the middles of neighbouring lines, perpendicular to them.
        pitch_log_sd: standard error of its log.
        length_px: median length of the lines.
    """

    ends: NDArray[np.float64]
    pitch_px: float
    pitch_log_sd: float
    length_px: float


def find_bay_rows(
    raster: Raster, scale: Interval, covers: Callable[[float, float], bool] | None = None
) -> list[BayRow]:
    """Find rows of at least six bay lines.

    Spectra of small windows show where stripes are; only there are lines sought.

    Args:
        raster: the image.
        scale: metres per pixel between which its scale lies.
        covers: whether to look around a place, x and y in pixels of the image; None looks everywhere.
    """
    pitches = _PITCH_M[0] / scale.high, _PITCH_M[1] / scale.low
    middle = math.sqrt(pitches[0] * pitches[1])
    factor = 1
    while middle / factor > _MOST_PITCH_PX:
        factor *= 2
    rows: list[BayRow] = []
    for window in tile_grid(
        raster.width_px // factor, raster.height_px // factor, tile_px=_TILE_PX, stride_px=_STRIDE_PX
    ):
        middle_px = (window.x_px + window.width_px / 2) * factor, (window.y_px + window.height_px / 2) * factor
        if covers is not None and not covers(*middle_px):
            continue
        rgb = read_reduced_window(raster, window, factor)
        grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        ground = np.asarray(cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((_BRIGHTER_PX,) * 2, np.uint8)), np.uint8)
        bright = np.asarray(cv2.subtract(grey, ground), np.uint8)
        striped = _striped(
            bright, _paved(rgb, ground), pitches[0] / factor, pitches[1] / factor, _MOST_SHARE * factor**2
        )
        if not striped.any():
            continue
        hidden = _enlarged(striped, grey.shape) == 0
        grey[hidden], bright[hidden] = np.median(grey[::4, ::4]), 0
        for x, y, width, height, _ in (_GRID_PX * cv2.connectedComponentsWithStats(striped)[2][1:]).tolist():
            part = slice(y, y + height), slice(x, x + width)
            corner = np.array([window.x_px + x, window.y_px + y])
            for row in _rows_in(grey[part], bright[part], scale.low * factor, scale.high * factor):
                ends = (row.ends + corner + 0.5) * factor - 0.5
                placed = BayRow(ends, row.pitch_px * factor, row.pitch_log_sd, row.length_px * factor)
                if not any(_same(placed, other) for other in rows):
                    rows.append(placed)
    return rows


def _striped(
    bright: NDArray[np.uint8], paved: NDArray[np.uint8], shortest_px: float, longest_px: float, most_share: float
) -> NDArray[np.uint8]:
    """Mask a share of a tile's windows, with the most power at one wavelength between two.

    Args:
        bright: ``[h, w]``, by how much a pixel is brighter than its surroundings, grey levels.
        paved: ``[h, w]``, 255 where the ground may be paved.
        shortest_px: shortest wavelength.
        longest_px: longest wavelength.
        most_share: largest share of the windows.

    Returns:
        Squares of ``_GRID_PX`` pixels ``[ceil(h / grid), ceil(w / grid)]``, 1 in these windows and around them.
    """
    height, width = bright.shape
    mask = np.zeros((-(-height // _GRID_PX), -(-width // _GRID_PX)), np.uint8)
    if min(height, width) < _CELL_PX:
        return mask + np.uint8(1)
    paint = np.asarray(cv2.bitwise_and(np.minimum(bright, _BRIGHTEST), paved), np.uint8)
    sums = cv2.integral(paint)
    sums = sums[_CELL_PX::_CELL_STEP_PX] - sums[:-_CELL_PX:_CELL_STEP_PX]
    marked = (sums[:, _CELL_PX::_CELL_STEP_PX] - sums[:, :-_CELL_PX:_CELL_STEP_PX]) / _CELL_PX**2
    places = np.argwhere(marked >= _LEAST_BRIGHT) * _CELL_STEP_PX
    if not len(places):
        return mask
    windows = np.lib.stride_tricks.sliding_window_view(paint, (_CELL_PX, _CELL_PX))
    striped = _periodic_share(windows[tuple(places.T)].astype(np.float32), shortest_px, longest_px)
    most = max(_MOST_CELLS, round(most_share * marked.size))
    order = np.argsort(-striped, kind="stable")[:most]
    for y, x in places[order[striped[order] >= _LEAST_STRIPED]].tolist():
        top, left = max(y - _AROUND_PX, 0) // _GRID_PX, max(x - _AROUND_PX, 0) // _GRID_PX
        reach = _CELL_PX + _AROUND_PX
        mask[top : (y + reach) // _GRID_PX, left : (x + reach) // _GRID_PX] = 1
    return mask


def _enlarged(mask: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Enlarge a mask of squares to pixels ``[h, w]``."""
    rows = np.repeat(mask, _GRID_PX, axis=0)[: shape[0]]
    return np.repeat(rows, _GRID_PX, axis=1)[:, : shape[1]]


def _paved(rgb: NDArray[np.uint8], ground: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Mask where the ground may be asphalt or concrete, grey, neither dark nor white: ``[h, w]``, 255 there."""
    red, green, blue = cv2.split(rgb)
    colour = cv2.subtract(cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue))
    colourless = cv2.inRange(colour, 0, _COLOURED - 1)
    return np.asarray(cv2.bitwise_and(colourless, cv2.inRange(ground, _DARKEST, _PALEST)), np.uint8)


def _periodic_share(windows: NDArray[np.float32], shortest_px: float, longest_px: float) -> NDArray[np.float32]:
    """Compute the largest share of each window's power at one wavelength between two.

    Only the few coefficients of these wavelengths are computed, as matrix products; the total is Parseval's.

    Args:
        windows: ``[n, side, side]``.
        shortest_px: shortest wavelength.
        longest_px: longest wavelength.

    Returns:
        ``[n]``.
    """
    side = windows.shape[1]
    taper = np.hanning(side).astype(np.float32)
    highest = min(math.ceil(side / shortest_px), side // 2 - 1)
    waves = np.arange(-highest, highest + 1)
    basis = (taper[:, None] * np.exp(-2j * np.pi / side * np.outer(np.arange(side), waves))).astype(np.complex64)
    half = basis[:, highest:]  # of a real window, half of the plane tells all
    centred = windows - windows.mean(axis=(1, 2), keepdims=True)
    rows = (centred.reshape(-1, side) @ np.hstack([half.real, half.imag])).reshape(len(windows), side, 2, -1)
    power = np.abs(basis.T @ (rows[:, :, 0] + 1j * rows[:, :, 1])) ** 2
    frequency = np.hypot(waves[:, None], waves[None, highest:]) / side
    ring = power * ((frequency >= 1 / longest_px) & (frequency <= 1 / shortest_px))
    near = ring.copy()
    near[..., 1:] += ring[..., :-1]
    near[..., :-1] += ring[..., 1:]
    squares = np.square(centred) @ np.square(taper) @ np.square(taper)
    level = np.square(rows[:, :, 0, 0] * taper).sum(axis=1)  # of the waves along y, which the half plane has twice
    total = (side**2 * squares + side * level) / 2
    return np.asarray(near.max(axis=(1, 2)) / (total + 1.0), np.float32)


def _rows_in(
    grey: NDArray[np.uint8], bright: NDArray[np.uint8], low_m_per_px: float, high_m_per_px: float
) -> list[BayRow]:
    """Find rows in a part of an image, enlarged if lines are hardly a pixel wide; in its pixels.

    Args:
        grey: grey levels ``[h, w]``.
        bright: ``[h, w]``, by how much narrow things are brighter than their surroundings: few other edges are left.
        low_m_per_px: finest scale.
        high_m_per_px: coarsest scale.
    """
    middle = math.sqrt(low_m_per_px * high_m_per_px)
    zoom = min(max(_LEAST_PITCH_PX * middle / math.sqrt(_PITCH_M[0] * _PITCH_M[1]), 1.0), 2.0)
    size = round(bright.shape[1] * zoom), round(bright.shape[0] * zoom)
    fine = bright if zoom == 1 else np.asarray(cv2.resize(bright, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    widest = max(_PAINT_M / middle, _PAINT_PX) * zoom
    lines = thin_lines(fine, widest, zoom * _LINE_M[0] / high_m_per_px, zoom * _LINE_M[1] / low_m_per_px)
    rows = rows_of(lines, zoom * _PITCH_M[0] / high_m_per_px, zoom * _PITCH_M[1] / low_m_per_px)
    shift = (zoom - 1) / 2
    found = [
        BayRow((row.ends - shift) / zoom, row.pitch_px / zoom, row.pitch_log_sd, row.length_px / zoom) for row in rows
    ]
    return [row for row in found if _opens_on_an_aisle(grey, row)]


def _opens_on_an_aisle(grey: NDArray[np.uint8], row: BayRow) -> bool:
    """Tell whether the ground of the bays goes on beyond their lines on one side, as an aisle's does.

    Halls, balconies, solar panels and hatched walkways end where their stripes end.
    """
    middles = row.ends.mean(axis=1)
    along = (row.ends[0, 1] - row.ends[0, 0]) / np.hypot(*(row.ends[0, 1] - row.ends[0, 0]))
    across = np.array([-along[1], along[0]]) * row.pitch_px / 2
    beside = np.concatenate([middles - across, middles + across])

    def levels(places: NDArray[np.float64], shifts: NDArray[np.float64]) -> NDArray[np.float64]:
        points = (places[:, None] + shifts[:, None] * along).reshape(-1, 2)
        inside = ((points >= 0) & (points < np.array(grey.shape[::-1]) - 0.5)).all(axis=1)
        columns, lines = np.rint(points[inside]).astype(np.intp).T
        return np.asarray(grey[lines, columns], np.float64)

    def alike(seen: NDArray[np.float64], least: float) -> bool:
        return len(seen) >= _LEAST_LINES and float(np.mean(np.abs(seen - ground) < _ALIKE)) >= least

    bays = levels(beside, _INSIDE * row.length_px)
    ground = float(np.median(bays))
    contrast = float(np.median(levels(middles, _INSIDE * row.length_px))) - ground
    if not (_DARKEST <= ground <= _PALEST and _PAINT[0] <= contrast <= _PAINT[1] and alike(bays, _LEAST_BARE)):
        return False
    for side in (-1, 1):
        beyond = side * (row.length_px / 2 + _BEYOND * row.pitch_px)
        if alike(levels(beside, beyond), _LEAST_OPEN) and alike(levels(middles, beyond), _LEAST_OPEN):
            return True
    return False


def rows_of(lines: Lines, least_pitch_px: float, most_pitch_px: float) -> list[BayRow]:
    """Find rows among lines, the longest first; each line is in one row at most.

    Args:
        lines: of an image.
        least_pitch_px: smallest pitch.
        most_pitch_px: largest pitch.
    """
    first, second = neighbours(lines.centres, 1.6 * most_pitch_px)
    turned = _turn(lines.angles[second] - lines.angles[first])
    along = np.stack([np.cos(lines.angles), np.sin(lines.angles)], axis=1)[first]
    offset = lines.centres[second] - lines.centres[first]
    pitch, shift = offset[:, 1] * along[:, 0] - offset[:, 0] * along[:, 1], (offset * along).sum(axis=1)
    alike = np.abs(np.log(lines.lengths[second] / lines.lengths[first])) < _AS_LONG
    alike &= (np.abs(turned) < _PARALLEL_RAD) & (np.abs(shift) < _STEEPEST * pitch)
    alike &= (pitch > least_pitch_px) & (pitch < most_pitch_px)
    candidates = [_members(lines, int(a), int(b)) for a, b in zip(first[alike], second[alike], strict=True)]
    free = np.ones(len(lines.angles), dtype=bool)
    rows = []
    for members, places in sorted(candidates, key=lambda each: -len(each[0])):
        left = free[members]
        row = _fitted(lines, members[left], places[left])
        if row is not None and least_pitch_px < row.pitch_px < most_pitch_px:
            free[members] = False
            rows.append(row)
    return rows


def _turn(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Reduce differences of directions without sense to -pi/2..pi/2."""
    return np.asarray((angles + math.pi / 2) % math.pi - math.pi / 2)


def _members(lines: Lines, first: int, second: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Collect the lines that continue two neighbours as a row, with their numbers in it."""
    along = np.array([math.cos(lines.angles[first]), math.sin(lines.angles[first])])
    across = np.array([-along[1], along[0]])
    offset = lines.centres - lines.centres[first]
    pitch, shift = float(offset[second] @ across), float(offset[second] @ along)
    place = offset @ across / pitch
    number = np.rint(place)
    good = np.abs(place - number) < _OFF_PITCH + _DRIFT * np.abs(number)
    good &= np.abs(offset @ along - number * shift) < _OFF_ALONG * lines.lengths[first]
    good &= np.abs(_turn(lines.angles - lines.angles[first])) < _PARALLEL_RAD
    good &= np.abs(np.log(lines.lengths / lines.lengths[first])) < _AS_LONG
    (members,) = np.nonzero(good)
    places = number[members].astype(np.intp)
    seen = np.unique(places)
    run = np.cumsum(np.r_[0, np.diff(seen) > _MOST_GAP])
    kept = seen[run == run[np.searchsorted(seen, 0)]]
    inside = (places >= kept[0]) & (places <= kept[-1])
    return members[inside], places[inside]


def _fitted(lines: Lines, members: NDArray[np.intp], places: NDArray[np.intp]) -> BayRow | None:
    """Fit the pitch by least squares; None unless the lines are a row of bays."""
    seen = np.unique(places)
    if len(seen) < _LEAST_LINES or len(seen) < _LEAST_FILL * (seen[-1] - seen[0] + 1):
        return None
    doubled = 2 * lines.angles[members]
    angle = math.atan2(float(np.sin(doubled).mean()), float(np.cos(doubled).mean())) / 2
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    centred = places - places.mean()
    spread = float(centred @ centred)
    offset = lines.centres[members] @ across
    pitch = float(centred @ offset) / spread
    residual = offset - offset.mean() - pitch * centred
    length = float(np.median(lines.lengths[members]))
    rms = math.sqrt(float(residual @ residual) / (len(members) - 2))
    if rms > _MOST_RMS * abs(pitch) or not any(low < length / abs(pitch) < high for low, high in _RATIOS):
        return None
    half = along * lines.lengths[members, None] / 2
    ends = np.stack([lines.centres[members] - half, lines.centres[members] + half], axis=1)
    return BayRow(ends, abs(pitch), rms / math.sqrt(spread) / abs(pitch), length)


def _same(row: BayRow, other: BayRow) -> bool:
    """Tell whether two rows of overlapping tiles share lines."""
    apart = row.ends.mean(axis=1)[:, None] - other.ends.mean(axis=1)[None]
    return bool((np.hypot(apart[..., 0], apart[..., 1]) < row.pitch_px / 4).sum() >= 2)
