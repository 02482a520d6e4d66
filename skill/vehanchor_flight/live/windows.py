"""Window of a frame to search next: where the last frames had cars, and now and then elsewhere."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.scale.defaults import CAR_LENGTH_M

if TYPE_CHECKING:
    from numpy.typing import NDArray

WINDOW_PX = 640  # side of a window in the reduced frame
_LONGEST_CAR_PX = 60.0  # in the reduced frame
_MOST_FACTOR = 8
_ELSEWHERE_EVERY = 4  # one window in four is the next in turn


def reduction_factor(gsd_m_per_px: float | None, width_px: int, height_px: int) -> int:
    """Choose the reduction of a frame at which cars have a length that the detector knows.

    Args:
        gsd_m_per_px: expected scale; None if unknown.
        width_px: width of the frame.
        height_px: height of the frame.

    Returns:
        A power of two, at which the frame's shorter side still has half a window.
    """
    factor = 1
    length_px = 0.0 if gsd_m_per_px is None else CAR_LENGTH_M / gsd_m_per_px
    while (
        length_px / factor > _LONGEST_CAR_PX
        and factor < _MOST_FACTOR
        and min(width_px, height_px) // (2 * factor) >= WINDOW_PX // 4
    ):
        factor *= 2
    return factor


def next_window(width_px: int, height_px: int, factor: int, turn: int, cars: NDArray[np.float64]) -> Window:
    """Choose the window to search in a frame.

    Args:
        width_px: width of the frame.
        height_px: height of the frame.
        factor: reduction of the frame.
        turn: number of the frame.
        cars: ``[n, 2]`` centres of the cars of the last frames, pixels of this frame.

    Returns:
        In pixels of the reduced frame: the window around the car with the most neighbours, or in every fourth turn and
        without cars the next of all windows.
    """
    width, height = width_px // factor, height_px // factor
    side = min(WINDOW_PX, width), min(WINDOW_PX, height)
    if len(cars) and turn % _ELSEWHERE_EVERY:
        corners = np.clip(np.rint(cars / factor - np.array(side) / 2), 0, np.array([width, height]) - np.array(side))
        around = [Window(int(left), int(top), *side) for left, top in corners]
        return around[int(np.argmax([_inside(cars / factor, each) for each in around]))]
    lefts, tops = (
        np.linspace(0, extent - own, math.ceil(extent / own)).astype(int).tolist()  # spread evenly
        for extent, own in zip((width, height), side, strict=True)
    )
    windows = [Window(left, top, *side) for top in tops for left in lefts]
    return windows[(turn // _ELSEWHERE_EVERY if len(cars) else turn) % len(windows)]


def _inside(points: NDArray[np.float64], window: Window) -> int:
    low = np.array([window.x_px, window.y_px])
    high = low + np.array([window.width_px, window.height_px])
    return int(np.all((points >= low) & (points < high), axis=1).sum())
