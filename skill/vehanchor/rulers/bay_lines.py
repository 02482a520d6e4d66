"""Thin bright lines: painted markings, seen as pairs of opposite edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SMOOTH_PX = 0.6  # of the grey levels before segments are found
_PROBE_PX = 1.5  # beside a segment, where its brighter side shows
_PROBES = (-0.3, -0.15, 0.0, 0.15, 0.3)  # of its length
_OPPOSITE_COS = -0.985  # ten degrees
_LEAST_WIDTH_PX = 0.3
_LEAST_OVERLAP = 0.5  # of the shorter edge
_BEFORE, _BEYOND = 0.6, 1.3  # of the shortest and longest line, an edge's length: edges break and overshoot


class Lines(NamedTuple):
    """Thin bright lines of an image.

    Attributes:
        centres: ``[n, 2]`` x and y of their middles, pixels; 0 is the centre of the first pixel.
        angles: ``[n]`` directions, radians in 0..pi.
        lengths: ``[n]`` pixels.
    """

    centres: NDArray[np.float64]
    angles: NDArray[np.float64]
    lengths: NDArray[np.float64]


def thin_lines(grey: NDArray[np.uint8], widest_px: float, shortest_px: float, longest_px: float) -> Lines:
    """Find thin bright lines by line segments (von Gioi et al., LSD) with their bright sides together.

    Args:
        grey: ``[h, w]`` grey levels.
        widest_px: largest distance between the two edges of a line.
        shortest_px: least length of a line.
        longest_px: largest length.
    """
    middles, along, lengths = _edges(grey, _BEFORE * shortest_px, _BEYOND * longest_px)
    first, second, width = _pairs(middles, along, lengths, widest_px)
    direction = along[first] - along[second]
    direction /= np.hypot(*direction.T)[:, None]
    half = lengths / 2
    shift = ((middles[second] - middles[first]) * direction).sum(axis=1)
    low = np.minimum(-half[first], shift - half[second])
    high = np.maximum(half[first], shift + half[second])
    across = np.stack([-along[first][:, 1], along[first][:, 0]], axis=1)
    centres = middles[first] + across * (width / 2)[:, None] + direction * ((low + high) / 2)[:, None]
    kept = (high - low >= shortest_px) & (high - low <= longest_px)
    angles = np.arctan2(direction[:, 1], direction[:, 0]) % np.pi
    return Lines(centres[kept], angles[kept], (high - low)[kept])


def _edges(
    grey: NDArray[np.uint8], shortest_px: float, longest_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Find segments: middles ``[n, 2]``, directions ``[n, 2]`` with the bright side to their left, lengths ``[n]``."""
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0).detect(smooth)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4)
    offsets = ends[:, 2:] - ends[:, :2]
    lengths = np.hypot(*offsets.T)
    kept = (lengths >= shortest_px) & (lengths <= longest_px)
    middles, along, lengths = (ends[kept, :2] + ends[kept, 2:]) / 2, offsets[kept] / lengths[kept, None], lengths[kept]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    probes = [middles + along * (share * lengths)[:, None] for share in _PROBES]
    brighter = sum(_at(grey, probe + across * _PROBE_PX) - _at(grey, probe - across * _PROBE_PX) for probe in probes)
    return middles, np.where((np.asarray(brighter) < 0)[:, None], -along, along), lengths


def _at(grey: NDArray[np.uint8], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Read the nearest grey levels; beyond the border, those of the border."""
    columns, rows = np.clip(np.rint(points).astype(np.intp), 0, np.array(grey.shape[::-1]) - 1).T
    return np.asarray(grey[rows, columns], np.float64)


def _pairs(
    middles: NDArray[np.float64], along: NDArray[np.float64], lengths: NDArray[np.float64], widest_px: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Pair each edge with the nearest opposite one on its bright side; each pair counts once, with its width."""
    first, second = neighbours(middles, lengths.max(initial=0.0))
    across = np.stack([-along[first][:, 1], along[first][:, 0]], axis=1)
    offset = middles[second] - middles[first]
    width, shift = (offset * across).sum(axis=1), (offset * along[first]).sum(axis=1)
    half, other = lengths[first] / 2, lengths[second] / 2
    overlap = np.minimum(half, shift + other) - np.maximum(-half, shift - other)
    good = (along[first] * along[second]).sum(axis=1) < _OPPOSITE_COS
    good &= (width > _LEAST_WIDTH_PX) & (width < widest_px)
    good &= overlap > _LEAST_OVERLAP * 2 * np.minimum(half, other)
    first, second, width = first[good], second[good], width[good]
    nearest = np.lexsort((width, first))
    first, second, width = first[nearest], second[nearest], width[nearest]
    right, down = (along[first] - along[second]).T  # the other way round, with both signs turned
    kept = np.r_[True, first[1:] != first[:-1]][: len(first)] & ((down > 0) | ((down == 0) & (right > 0)))
    return first[kept], second[kept], width[kept]


def neighbours(points: NDArray[np.float64], reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """List the ordered pairs of points whose columns and rows differ by at most ``reach``."""
    order = np.argsort(points[:, 0], kind="stable")
    ranked = points[order]
    low = np.searchsorted(ranked[:, 0], ranked[:, 0] - reach, "left")
    high = np.searchsorted(ranked[:, 0], ranked[:, 0] + reach, "right")
    counts = high - low
    first = np.repeat(np.arange(len(points)), counts)
    second = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
    kept = (np.abs(ranked[second, 1] - ranked[first, 1]) <= reach) & (first != second)
    return order[first[kept]], order[second[kept]]
