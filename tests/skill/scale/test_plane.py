"""The ground plane: scales, lengths and areas under a tilted camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.errors import TooObliqueError
from vehanchor.scale.plane import GroundPlane


def _plane(tilt: float, roll: float = 0.0, focal: float = 2000.0, gsd: float = 0.1) -> GroundPlane:
    return GroundPlane(gsd, tilt, focal_px=focal, width_px=1600, height_px=1200, roll_deg=roll)


def _mask(x: int, y: int, side: int = 40) -> np.ndarray:
    mask = np.zeros((1200, 1600), dtype=bool)
    mask[y : y + side, x : x + side] = True
    return mask


def test_straight_down_one_scale_holds_everywhere() -> None:
    plane = _plane(0.0)
    assert plane.gsd_at([[0, 0], [800, 600], [1600, 1200]]) == pytest.approx(0.1)
    assert plane.length([[10, 10]], [[13, 14]]) == pytest.approx(0.5)
    assert plane.area(_mask(3, 5)) == pytest.approx(1600 * 0.01)
    assert plane.height_m == pytest.approx(200.0)


@given(
    tilt=st.floats(0, 50), roll=st.floats(-180, 180), x=st.floats(100, 1500), y=st.floats(100, 1100)
)
def test_the_scale_of_a_pixel_is_the_root_of_the_ground_it_shows(
    tilt: float, roll: float, x: float, y: float
) -> None:
    plane = _plane(tilt, roll)
    here, right, below = plane.ground([[x, y], [x + 1e-3, y], [x, y + 1e-3]])
    area = float(np.linalg.norm(np.cross(right - here, below - here))) / 1e-6
    assert plane.gsd_at([[x, y]])[0] ** 2 == pytest.approx(area, rel=1e-3)


@given(tilt=st.floats(0, 50), roll=st.floats(-180, 180))
def test_all_of_the_ground_lies_in_one_plane_at_the_cameras_height(
    tilt: float, roll: float
) -> None:
    plane = _plane(tilt, roll)
    places = plane.ground([[100, 100], [1500, 100], [800, 600], [30, 1100]])
    assert places @ plane.down == pytest.approx(plane.height_m)
    assert np.linalg.norm(plane.down) == pytest.approx(1.0)


def test_without_roll_the_upper_side_is_farther() -> None:
    upper, centre, lower = _plane(40.0).gsd_at([[800, 100], [800, 600], [800, 1100]])
    assert upper > centre > lower
    assert centre == pytest.approx(0.1)


def test_with_a_roll_of_90_degrees_the_right_side_is_farther() -> None:
    left, _, right = _plane(40.0, roll=90.0).gsd_at([[300, 600], [800, 600], [1300, 600]])
    assert right > left


@pytest.mark.parametrize(("x", "y"), [(0, 900), (900, 100)])
def test_the_area_under_a_mask_is_that_of_the_ground_between_its_corners(x: int, y: int) -> None:
    plane = _plane(45.0, focal=1500.0)
    first, second, third, fourth = plane.ground(
        [[x, y], [x + 200, y], [x + 200, y + 200], [x, y + 200]]
    )
    between = np.linalg.norm(np.cross(third - first, fourth - second)) / 2
    assert plane.area(_mask(x, y, 200)) == pytest.approx(between, rel=1e-4)


def test_a_mask_of_a_part_lies_at_its_place_in_the_image() -> None:
    plane = _plane(45.0)
    whole = _mask(0, 0, 20)
    outside_part = whole & ~_mask(3, 5, 40)
    part = plane.area(whole[5:, 3:], left=3, top=5)
    assert part == pytest.approx(plane.area(whole) - plane.area(outside_part), rel=1e-9)


def test_an_image_with_the_horizon_is_refused() -> None:
    with pytest.raises(TooObliqueError, match="horizon") as caught:
        _plane(80.0).check()
    assert caught.value.code == "too_oblique"


def test_an_image_below_the_horizon_is_accepted() -> None:
    _plane(45.0).check()


def test_only_points_above_the_horizon_are_refused() -> None:
    with pytest.raises(TooObliqueError):
        _plane(80.0).gsd_at([[800, 0]])
    assert _plane(80.0).gsd_at([[800, 1100]])[0] > 0
