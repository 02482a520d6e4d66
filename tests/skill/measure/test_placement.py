from __future__ import annotations

import math
import time

import numpy as np
import pytest

from vehanchor.imagery.raster import Window
from vehanchor.measure.placement import Grid, make_grid, place_circle, place_rectangle
from vehanchor.measure.polygon import bounds_of, mask_of
from vehanchor.scale.plane import GroundPlane
from vehanchor.segmentation.object_mask import ObjectMask

CENTRE = (1000.3, 800.7)


def _ring(length: float, width: float, heading_deg: float) -> np.ndarray:
    """Corners of a rectangle around ``CENTRE``."""
    heading = math.radians(heading_deg)
    along = np.array([math.sin(heading), -math.cos(heading)]) * length / 2
    across = np.array([math.cos(heading), math.sin(heading)]) * width / 2
    corners = [along + across, along - across, -along - across, -along + across]
    return np.array(corners) + CENTRE


def _grid(ring: np.ndarray, *, as_polygon: bool, plane: GroundPlane | None = None) -> Grid:
    left, top, right, bottom = bounds_of([[ring]])
    window = Window(left, top, width_px=right - left, height_px=bottom - top)
    pixels = ObjectMask(mask_of([[ring]], (left, top, right, bottom)), window)
    return make_grid(pixels, ((ring,),) if as_polygon else (), plane)


@pytest.mark.parametrize("as_polygon", [False, True])
@pytest.mark.parametrize("heading_deg", [0.0, 7.5, 41.0, 90.0, 133.3])
@pytest.mark.parametrize("length", [60.0, 300.0, 1400.0])
def test_a_rectangle_fits_into_itself(length: float, heading_deg: float, as_polygon: bool) -> None:
    ring = _ring(length, length / 2, heading_deg)
    placed = place_rectangle(_grid(ring, as_polygon=as_polygon), 2.0, 1.0)
    assert placed is not None
    # Rounded up to whole cells and pixels, so never larger.
    assert length * 0.93 <= placed.length_px <= length * 1.005
    assert placed.width_px == pytest.approx(placed.length_px / 2)
    assert placed.centre_in_image == pytest.approx(CENTRE, abs=length / 100 + 0.5)
    difference = (placed.heading_deg - heading_deg + 90) % 180 - 90
    assert abs(difference) < 1.5


def test_the_corners_have_the_size_that_is_asked_for() -> None:
    placed = place_rectangle(_grid(_ring(300, 150, 41), as_polygon=True), 2.0, 1.0)
    assert placed is not None
    corners = placed.corners(100, 50)
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
    assert sides == pytest.approx([100, 50, 100, 50])
    assert corners.mean(axis=0) == pytest.approx(placed.centre_in_image)


@pytest.mark.parametrize("seed", range(6))
def test_the_placed_rectangle_lies_inside(seed: int) -> None:
    shapely = pytest.importorskip("shapely")
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 2 * np.pi, 9))
    radii = rng.uniform(60, 200, 9)
    ring = np.stack([300 + radii * np.cos(angles), 300 + radii * np.sin(angles)], axis=1)
    placed = place_rectangle(_grid(ring, as_polygon=True), 3.0, 1.0)
    assert placed is not None
    corners = placed.corners(placed.length_px, placed.width_px)
    outside = shapely.Polygon(corners).difference(shapely.Polygon(ring))
    assert outside.area < 0.02 * shapely.Polygon(corners).area


def test_a_corridor_holds_a_long_rectangle_only_lengthwise() -> None:
    placed = place_rectangle(_grid(_ring(400, 40, 30), as_polygon=True), 5.0, 1.0)
    assert placed is not None
    assert placed.width_px == pytest.approx(40, rel=0.05)
    assert placed.heading_deg == pytest.approx(30, abs=1)


def test_a_hole_is_not_free() -> None:
    mask = np.ones((100, 200), dtype=bool)
    mask[45:55, 95:105] = False
    pixels = ObjectMask(mask, Window(0, 0, width_px=200, height_px=100))
    placed = place_rectangle(make_grid(pixels), 2.0, 1.0)
    assert placed is not None
    # Beside the hole and upright; without the hole it would be 200 px long.
    assert placed.length_px == pytest.approx(100, abs=1)


def test_the_largest_circle_is_that_of_a_square() -> None:
    placed = place_circle(_grid(_ring(100, 100, 0), as_polygon=True))
    assert placed is not None
    assert placed.diameter_px == pytest.approx(100, rel=0.01)
    assert placed.centre == pytest.approx(CENTRE, abs=0.5)


@pytest.mark.parametrize(("length", "width", "n"), [(100, 50, 50), (101, 50, 40), (500, 500, 1)])
def test_rectangles_are_counted_in_rows(length: float, width: float, n: int) -> None:
    pixels = ObjectMask(np.ones((500, 500), bool), Window(0, 0, width_px=500, height_px=500))
    placed = place_rectangle(make_grid(pixels), 2.0, 1.0)
    assert placed is not None
    assert placed.count_rows(length, width) == n
    assert placed.count_rows(600, 10) == 0


def test_rows_may_begin_anywhere() -> None:
    mask = np.ones((100, 500), dtype=bool)
    # The lower row begins behind a notch of 7 rows.
    mask[:7, 200:] = False
    pixels = ObjectMask(mask, Window(0, 0, width_px=500, height_px=100))
    placed = place_rectangle(make_grid(pixels), 2.0, 1.0)
    assert placed is not None
    assert placed.count_rows(60, 46) == 16


def test_a_sliver_of_a_mask_has_no_room() -> None:
    mask = np.eye(200, dtype=bool)
    placed = place_rectangle(
        make_grid(ObjectMask(mask, Window(0, 0, width_px=200, height_px=200))), 2.0, 1.0
    )
    assert placed is None or placed.length_px <= 4


@pytest.mark.parametrize("as_polygon", [False, True])
def test_a_tilted_camera_places_on_the_ground(as_polygon: bool) -> None:
    plane = GroundPlane(gsd_m_per_px=0.1, tilt_deg=35, focal_px=2000, width_px=2000, height_px=1600)
    # A rectangle on the ground, seen by the tilted camera.
    wanted = np.array([(-100, 50), (100, 50), (100, 150), (-100, 150)], dtype=np.float64)
    grid_of_image = np.stack(np.meshgrid(np.arange(700, 1400, 2), np.arange(700, 1100, 2)), -1)
    ground = plane.from_above(grid_of_image.reshape(-1, 2).astype(np.float64))
    inside = (np.abs(ground[:, 0]) <= 100) & (ground[:, 1] >= 50) & (ground[:, 1] <= 150)
    seen = grid_of_image.reshape(-1, 2)[inside]
    nearest = [int(np.argmin(np.linalg.norm(ground - corner, axis=1))) for corner in wanted]
    ring = grid_of_image.reshape(-1, 2)[nearest].astype(np.float64)
    assert len(seen)
    placed = place_rectangle(_grid(ring, as_polygon=as_polygon, plane=plane), 2.0, 1.0)
    assert placed is not None
    assert placed.length_px == pytest.approx(200, rel=0.03)
    assert placed.centre_in_image == pytest.approx(ring.mean(axis=0), abs=6)


@pytest.mark.parametrize("side", [100, 500, 4000])
@pytest.mark.slow
def test_a_placement_takes_a_fraction_of_a_second(side: int) -> None:
    y, x = np.mgrid[:side, :side] - side / 2
    pixels = ObjectMask(x**2 + y**2 < side**2 / 4, Window(0, 0, width_px=side, height_px=side))
    start = time.perf_counter()
    assert place_rectangle(make_grid(pixels), 3.0, 1.0) is not None
    # 0.2 s on one core that does nothing else.
    assert time.perf_counter() - start < 2
