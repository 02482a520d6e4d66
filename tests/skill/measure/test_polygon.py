from __future__ import annotations

import time

import numpy as np
import pytest

from vehanchor.measure.polygon import (
    area_of,
    bounds_of,
    extents_of,
    find_crossing,
    mask_of,
    perimeter_of,
)

SQUARE = np.array([(10, 10), (40, 10), (40, 40), (10, 40)], dtype=np.float64)
HOLE = np.array([(20, 20), (30, 20), (30, 30), (20, 30)], dtype=np.float64)
BOW_TIE = np.array([(0, 0), (10, 10), (10, 0), (0, 10)], dtype=np.float64)


def _star(seed: int) -> np.ndarray:
    """A random polygon whose corners go around the middle."""
    rng = np.random.default_rng(seed)
    n_corners = int(rng.integers(3, 12))
    angles = np.sort(rng.uniform(0, 2 * np.pi, n_corners))
    radii = rng.uniform(5, 40, n_corners)
    return np.stack([50 + radii * np.cos(angles), 50 + radii * np.sin(angles)], axis=1)


def test_the_area_leaves_out_holes() -> None:
    assert area_of([[SQUARE, HOLE]]) == 800
    assert area_of([[SQUARE], [HOLE + 50]]) == 1000


def test_far_from_the_corner_the_area_is_as_exact() -> None:
    assert area_of([[SQUARE + 1e7]]) == 900


def test_the_perimeter_has_that_of_holes() -> None:
    assert perimeter_of([[SQUARE, HOLE]]) == 160


def test_the_extents_are_those_of_the_smallest_rectangle() -> None:
    turned = SQUARE @ np.array([(0.8, -0.6), (0.6, 0.8)])
    assert extents_of([[turned]]) == pytest.approx((30, 30), rel=1e-5)


def test_the_pixels_of_whole_corners_are_the_area() -> None:
    assert mask_of([[SQUARE, HOLE]], bounds_of([[SQUARE]])).sum() == 800


@pytest.mark.parametrize("seed", range(20))
def test_pixels_are_those_whose_centres_shapely_finds_inside(seed: int) -> None:
    shapely = pytest.importorskip("shapely")
    ring = _star(seed)
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(100) + 0.5)
    inside = shapely.contains_xy(shapely.Polygon(ring), x, y)
    assert np.array_equal(mask_of([[ring]], (0, 0, 100, 100)), inside)


@pytest.mark.parametrize("seed", range(20))
def test_area_and_perimeter_are_those_of_shapely(seed: int) -> None:
    shapely = pytest.importorskip("shapely")
    ring = _star(seed)
    polygon = shapely.Polygon(ring)
    assert area_of([[ring]]) == pytest.approx(polygon.area)
    assert perimeter_of([[ring]]) == pytest.approx(polygon.length)


def test_finer_cells_fill_the_same_area() -> None:
    n_cells = mask_of([[_star(3)]], (0, 0, 100, 100), 8).sum()
    assert n_cells / 64 == pytest.approx(area_of([[_star(3)]]), rel=0.01)


def test_a_crossing_is_found_with_its_place() -> None:
    assert find_crossing([BOW_TIE]) == pytest.approx((5, 5))
    assert find_crossing([SQUARE, SQUARE + 15]) is not None


def test_touching_lines_do_not_cross() -> None:
    assert find_crossing([SQUARE, np.add(SQUARE, (30, 0))]) is None
    assert find_crossing([SQUARE, SQUARE + 30]) is None


@pytest.mark.parametrize("seed", range(100))
def test_crossings_are_those_of_shapely(seed: int) -> None:
    shapely = pytest.importorskip("shapely")
    ring = np.random.default_rng(seed).uniform(0, 100, (6, 2))
    assert (find_crossing([ring]) is None) == shapely.Polygon(ring).is_valid


@pytest.mark.slow
def test_many_corners_are_compared_quickly() -> None:
    angles = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    circle = 1000 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    start = time.perf_counter()
    assert find_crossing([circle]) is None
    assert time.perf_counter() - start < 2
