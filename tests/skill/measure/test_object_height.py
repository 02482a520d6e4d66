from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from tests.models import blank_image
from vehanchor.cli import app as cli
from vehanchor.errors import InvalidParameterError, TooObliqueError
from vehanchor.measure.resolved_scale import CameraAbove, ResolvedScale, raised
from vehanchor.measure.spread import Spread
from vehanchor.pictures.scale import write_picture
from vehanchor.scale.plane import GroundPlane

FOCAL_35MM = 24.0
FOCAL_PX = FOCAL_35MM * np.hypot(1000, 750) / np.hypot(36, 24)
GROUND = 0.05  # metres per pixel: the camera is 50 m up by the given height
LINE = [(100.0, 100.0), (500.0, 400.0)]  # 500 px


def _distance(**options: Any) -> Any:
    return vehanchor.measure_distance(blank_image(1000, 750), LINE, gsd_m_per_px=GROUND, **options)


def test_a_roof_is_shorter_than_the_same_pixels_on_the_ground_by_its_share_of_the_cameras_height() -> None:
    ground = _distance(height_m=50.0)
    roof = _distance(height_m=50.0, object_height_m=10.0)
    assert ground.distance_m == pytest.approx(25)
    assert (roof.distance_m, roof.gsd_m_per_px) == (pytest.approx(20), pytest.approx(0.8 * GROUND))
    assert _distance(height_m=50.0, object_height_m=0.0) == ground
    assert roof.distance_ci95_high_m / roof.distance_m > ground.distance_ci95_high_m / ground.distance_m


def test_with_a_lens_the_cameras_height_is_that_of_the_scale() -> None:
    roof = _distance(height_m=70.0, focal_35mm=FOCAL_35MM, object_height_m=10.0)
    assert roof.gsd_m_per_px == pytest.approx(GROUND - 10 / FOCAL_PX)


def test_an_area_on_a_roof_is_smaller_by_the_square() -> None:
    image = blank_image(400, 300)
    image[100:200, 120:260] = (200, 60, 40)
    common: dict[str, Any] = {"box": (110, 90, 270, 210), "gsd_m_per_px": GROUND, "height_m": 50.0}
    more_options: tuple[dict[str, Any], ...] = ({}, {"object_height_m": 10.0})
    ground, roof = (vehanchor.measure_area(image, **common, **more) for more in more_options)
    assert ground.area_m2 is not None
    assert roof.area_m2 == pytest.approx(0.64 * ground.area_m2)


def test_under_a_camera_that_looked_aside_the_whole_plane_is_raised() -> None:
    plane = GroundPlane(GROUND, 40.0, FOCAL_PX, 1000, 750)
    found = ResolvedScale(GROUND, Spread(0.05, 0.05), 0.9, "estimated", None, (), plane)
    up = raised(found, 5.0, CameraAbove(None, 999.0))
    share = 5.0 / plane.height_m
    assert up.gsd_m_per_px == pytest.approx(GROUND * (1 - share))
    assert up.length_m(LINE) == pytest.approx((found.length_m(LINE) or 0) * (1 - share))


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"object_height_m": 10.0}, InvalidParameterError, "give height_m"),
        ({"object_height_m": 60.0, "height_m": 50.0}, TooObliqueError, "above the camera"),
        ({"object_height_m": 50.0, "height_m": 50.0}, TooObliqueError, "above the camera"),
        ({"object_height_m": -1.0, "height_m": 50.0}, InvalidParameterError, "0 to 1000"),
        ({"object_height_m": float("nan"), "height_m": 50.0}, InvalidParameterError, "finite"),
        ({"object_height_m": "tall", "height_m": 50.0}, InvalidParameterError, "finite"),
    ],
)
def test_a_height_that_means_nothing_is_refused(options: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        _distance(**options)


def test_the_commands_take_it(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", blank_image(1000, 750))
    ends = ["--point", 100, 100, "--point", 500, 400]
    asked = ["distance", tmp_path / "a.png", *ends, "--gsd", GROUND, "--json", "--height", 50, "--object-height", 10]
    result = CliRunner().invoke(cli.app, [str(each) for each in asked])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["distance_m"] == pytest.approx(20)
