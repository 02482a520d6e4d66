"""Pictures of all directions, without metadata."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.sphere import is_sphere


def _texture(height_px: int, width_px: int) -> NDArray[np.float64]:
    """Make a picture whose left and right borders continue each other."""
    cells = np.random.default_rng(5).normal(0, 45, (12, 24))
    tiled = np.hstack([cells, cells, cells])
    size = (3 * width_px, height_px)
    smooth = cv2.resize(tiled, size, interpolation=cv2.INTER_CUBIC)
    return np.asarray(smooth[:, width_px : 2 * width_px])


def _is_sphere(grey: NDArray[np.float64]) -> bool:
    levels = np.clip(grey + 120, 0, 255).astype(np.uint8)
    with open_raster(np.repeat(levels[:, :, None], 3, axis=2)) as raster:
        return is_sphere(raster)


def _sphere() -> NDArray[np.float64]:
    """Make a picture whose first and last rows are points."""
    rows = np.arange(200)[:, None]
    at_poles = np.clip(np.minimum(rows, rows[::-1]) / 40, 0, 1)
    return _texture(200, 400) * at_poles


def test_a_picture_of_all_directions_is_recognised() -> None:
    assert _is_sphere(_sphere())


def test_a_picture_of_these_proportions_is_none_if_its_borders_differ() -> None:
    assert not _is_sphere(np.hstack([_sphere()[:, 130:], _sphere()[:, :60], _sphere()[:, 70:140]]))


def test_a_picture_of_these_proportions_is_none_without_poles() -> None:
    assert not _is_sphere(_texture(200, 400))


def test_a_sphere_has_twice_its_height_as_width() -> None:
    assert not _is_sphere(_sphere()[:, :390])
