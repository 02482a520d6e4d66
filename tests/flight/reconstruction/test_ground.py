from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.flight.reconstruction.flights import FOCAL_PX, HEIGHT_PX, WIDTH_PX, Pose
from vehanchor.errors import ReconstructionError
from vehanchor_flight.reconstruction.ground import local_heights, model_plane, plane_below
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot

LENS = Lens(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2)
RNG = np.random.default_rng(2)
GROUND = np.column_stack([RNG.uniform(0, 100, 600), -RNG.uniform(0, 100, 600), RNG.normal(0, 0.1, 600)])
ROOF = np.column_stack([RNG.uniform(20, 60, 900), -RNG.uniform(20, 60, 900), RNG.normal(20, 0.1, 900)])
FACE = np.column_stack([RNG.uniform(20, 60, 700), np.full(700, -60.0), RNG.uniform(0, 20, 700)])


def _shot(pose: Pose) -> Shot:
    return Shot("a", LENS, pose.rotation, pose.translation)


def _model(*parts: np.ndarray) -> Reconstruction:
    shots = tuple(_shot(Pose(x, y, 60)) for x, y in ((30, 30), (60, 30), (40, 60)))
    return Reconstruction("opensfm", Path("a"), shots, np.concatenate(parts))


def test_the_ground_lies_below_roofs_with_more_points_and_beside_faces() -> None:
    plane = model_plane(_model(GROUND, ROOF, FACE))
    assert plane.normal == pytest.approx([0, 0, 1], abs=0.01)
    assert plane.heights(np.array([[50.0, -50, 60]])) == pytest.approx([60], abs=0.5)
    shot = _shot(Pose(45, 75, 60, 20))
    points = np.concatenate([GROUND, ROOF, FACE])
    below = plane_below(shot, points[shot.sees(points)], plane)
    assert below.heights(shot.centre[None]) == pytest.approx([60], abs=1)


def test_a_slope_has_a_plane_of_its_own_below_each_shot() -> None:
    slope = GROUND + np.outer(0.15 * GROUND[:, 0], [0, 0, 1])
    shot = _shot(Pose(50, 50, 60))
    level = model_plane(_model(GROUND))
    plane = plane_below(shot, slope, level)
    assert plane.heights(shot.centre[None]) == pytest.approx([(60 - 7.5) * np.cos(np.arctan(0.15))], abs=0.3)


@pytest.mark.timeout(60)
def test_two_slopes_of_a_hill_do_not_take_turns() -> None:
    hill = GROUND + np.outer(20 - 0.2 * np.abs(GROUND[:, 0] - 55), [0, 0, 1])
    shot = _shot(Pose(50, 50, 80))
    plane = plane_below(shot, hill, model_plane(_model(GROUND)))
    assert abs(plane.normal[0]) == pytest.approx(math.sin(math.atan(0.2)), abs=0.02)  # one of the slopes


def test_faces_of_houses_are_no_ground() -> None:
    face = np.column_stack([RNG.uniform(0, 100, 700), RNG.normal(-50, 0.02, 700), RNG.uniform(0, 40, 700)])
    plane = plane_below(_shot(Pose(50, 50, 60)), np.concatenate([face, face - [0, 30, 0]]), model_plane(_model(GROUND)))
    assert plane.normal[2] >= math.cos(math.radians(15))


def test_points_around_a_car_raise_its_ground() -> None:
    plane = model_plane(_model(GROUND))
    bump = np.column_stack([RNG.uniform(70, 80, 60), -RNG.uniform(70, 80, 60), np.full(60, 4.0)])
    places = np.array([[75.0, -75, 0], [20, -20, 0], [900, 900, 0]])
    heights = local_heights(places, np.concatenate([GROUND, bump]), plane, 60.0)
    assert heights == pytest.approx([4, 0, 0], abs=0.3)


def test_a_model_without_ground_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="too few"):
        model_plane(_model(GROUND[:10]))
    with pytest.raises(ReconstructionError, match="below the ground"):
        plane_below(_shot(Pose(50, 50, -5)), GROUND, model_plane(_model(GROUND)))
