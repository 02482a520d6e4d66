from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.flight.reconstruction.flights import FOCAL_PX, HEIGHT_PX, WIDTH_PX, Pose
from vehanchor.errors import ReconstructionError
from vehanchor_flight.reconstruction.ground import (
    Plane,
    local_heights,
    model_plane,
    plane_below,
)
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

LENS = Lens(
    WIDTH_PX,
    HEIGHT_PX,
    focal_x_px=FOCAL_PX,
    focal_y_px=FOCAL_PX,
    centre_x_px=WIDTH_PX / 2,
    centre_y_px=HEIGHT_PX / 2,
)


def _ground() -> NDArray[np.float64]:
    """Scatter points over level ground."""
    rng = np.random.default_rng(2)
    x = rng.uniform(0, 100, 600)
    y = -rng.uniform(0, 100, 600)
    return np.column_stack([x, y, rng.normal(0, 0.1, 600)])


def _house() -> NDArray[np.float64]:
    """Scatter points over a roof 20 m above the ground and one wall, more than on the ground."""
    rng = np.random.default_rng(3)
    roof_x = rng.uniform(20, 60, 900)
    roof_y = -rng.uniform(20, 60, 900)
    roof = np.column_stack([roof_x, roof_y, rng.normal(20, 0.1, 900)])
    wall_x = rng.uniform(20, 60, 700)
    wall = np.column_stack([wall_x, np.full(700, -60.0), rng.uniform(0, 20, 700)])
    return np.concatenate([roof, wall])


GROUND = _ground()
TOWN = np.concatenate([GROUND, _house()])
UP = np.array([0, 0, 1])


def _shot(pose: Pose) -> Shot:
    return Shot("a", LENS, rotation=pose.rotation, translation=pose.translation)


def _plane_of(points: NDArray[np.float64]) -> Plane:
    """Find the plane of a model with these points and three cameras."""
    shots = tuple(_shot(Pose(x, y, 60)) for x, y in ((30, 30), (60, 30), (40, 60)))
    return model_plane(Reconstruction("opensfm", Path("a"), shots=shots, points=points))


def test_the_ground_of_a_model_lies_below_roofs_with_more_points() -> None:
    plane = _plane_of(TOWN)
    assert plane.normal == pytest.approx([0, 0, 1], abs=0.01)
    assert plane.heights(np.array([[50.0, -50, 60]])) == pytest.approx([60], abs=0.5)


def test_the_ground_of_a_shot_lies_below_roofs_with_more_points() -> None:
    shot = _shot(Pose(45, 75, 60, 20))
    below = plane_below(shot, TOWN[shot.sees(TOWN)], _plane_of(TOWN))
    assert below.heights(shot.centre[None]) == pytest.approx([60], abs=1)


def test_a_slope_has_a_plane_of_its_own_below_each_shot() -> None:
    slope = GROUND + np.outer(0.15 * GROUND[:, 0], UP)
    shot = _shot(Pose(50, 50, 60))
    plane = plane_below(shot, slope, _plane_of(GROUND))
    expected = (60 - 7.5) * np.cos(np.arctan(0.15))
    assert plane.heights(shot.centre[None]) == pytest.approx([expected], abs=0.3)


@pytest.mark.timeout(60)
def test_two_slopes_of_a_hill_do_not_take_turns() -> None:
    hill = GROUND + np.outer(20 - 0.2 * np.abs(GROUND[:, 0] - 55), UP)
    plane = plane_below(_shot(Pose(50, 50, 80)), hill, _plane_of(GROUND))
    slope_of_one_side = math.sin(math.atan(0.2))
    assert abs(plane.normal[0]) == pytest.approx(slope_of_one_side, abs=0.02)


def test_walls_of_houses_are_not_the_ground() -> None:
    rng = np.random.default_rng(4)
    x = rng.uniform(0, 100, 700)
    y = rng.normal(-50, 0.02, 700)
    wall = np.column_stack([x, y, rng.uniform(0, 40, 700)])
    walls = np.concatenate([wall, wall - [0, 30, 0]])
    plane = plane_below(_shot(Pose(50, 50, 60)), walls, _plane_of(GROUND))
    assert plane.normal[2] >= math.cos(math.radians(15))


def test_points_around_a_car_raise_its_ground() -> None:
    rng = np.random.default_rng(5)
    x = rng.uniform(70, 80, 60)
    y = -rng.uniform(70, 80, 60)
    mound = np.column_stack([x, y, np.full(60, 4.0)])
    points = np.concatenate([GROUND, mound])
    on_mound = [75.0, -75, 0]
    on_level = [20, -20, 0]
    far_away = [900, 900, 0]
    places = np.array([on_mound, on_level, far_away])
    heights = local_heights(places, points, plane=_plane_of(GROUND), camera_height=60.0)
    assert heights == pytest.approx([4, 0, 0], abs=0.3)


def test_a_model_with_too_few_points_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="too few"):
        _plane_of(GROUND[:10])


def test_a_camera_below_the_ground_is_refused() -> None:
    level = _plane_of(GROUND)
    with pytest.raises(ReconstructionError, match="below the ground"):
        plane_below(_shot(Pose(50, 50, -5)), GROUND, level)
