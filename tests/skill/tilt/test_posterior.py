from __future__ import annotations

import numpy as np
import pytest

from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.focal import Focal
from vehanchor.tilt.posterior import GimbalCue, downs_of, tilt_posterior

FOCAL = Focal(1000.0, 0.0)


@pytest.mark.parametrize(("tilt_deg", "roll_deg"), [(12.0, 0.0), (35.0, -8.0), (50.0, 100.0)])
def test_a_gimbal_alone_is_believed(tilt_deg: float, roll_deg: float) -> None:
    found = tilt_posterior([GimbalCue(tilt_deg, roll_deg, 1.5)], FOCAL)
    assert found is not None
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=0.3)
    assert found.roll_deg == pytest.approx(roll_deg, abs=2)
    assert found.low_deg < tilt_deg - 2
    assert found.high_deg > tilt_deg + 2
    assert found.chance_above(5) > 0.99
    assert found.focal_px == pytest.approx(1000)


def test_two_that_agree_are_surer_and_of_two_that_do_not_the_sharper_leads() -> None:
    one, other = GimbalCue(30.0, 0.0, 3.0), GimbalCue(34.0, 0.0, 1.0)
    alone, both = tilt_posterior([one], FOCAL), tilt_posterior([one, other], FOCAL)
    assert alone is not None
    assert both is not None
    assert 33 < both.tilt_deg < 34
    assert both.high_deg - both.low_deg < (alone.high_deg - alone.low_deg) / 1.5


def test_directions_straight_down_are_those_of_the_plane() -> None:
    plane = GroundPlane(1.0, 33.0, 1000.0, 800, 600, 12.0)
    tilt_from_vehicles = 33.0 * np.array([[-np.sin(np.radians(12)), np.cos(np.radians(12))]])
    assert downs_of(tilt_from_vehicles)[0] == pytest.approx(plane.down)


def test_a_view_from_above_is_level_and_of_the_scale_of_the_centre() -> None:
    plane = GroundPlane(0.1, 40.0, 700.0, 800, 600, 5.0)
    ends = np.array([[100.0, 50.0], [700.0, 500.0], [400.0, 300.0]])
    above = plane.from_above(ends)
    assert above[2] == pytest.approx([0.0, 0.0])
    lengths = plane.length(ends[:2], ends[[2, 2]])
    assert 0.1 * np.hypot(*above[:2].T) == pytest.approx(lengths)
    assert above[0][1] < 0 < above[1][1]
