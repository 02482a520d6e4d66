from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from tests.analyses import made_card
from tests.skill.courts.drawing import draw_court
from vehanchor.courts.court import Court
from vehanchor.courts.find import measure_court
from vehanchor.courts.match import Pose
from vehanchor.courts.proposals import Proposal
from vehanchor.courts.rectified import RectifiedRaster, rough_courts_on
from vehanchor.courts.template import TENNIS
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers import courts as ruler
from vehanchor.rulers.court_cue import court_cues
from vehanchor.rulers.view import View
from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.focal import Focal
from vehanchor.tilt.posterior import GimbalCue, tilt_posterior

SIZE, FOCAL, GSD = 600, 650.0, 0.1
NOTHING = Detections(np.zeros((0, 5)), np.zeros(0))


def _aside(tilt_deg: float, roll_deg: float = 4.0) -> tuple[np.ndarray, GroundPlane]:
    """A court on grey ground as a camera sees it that looked aside."""
    plane = GroundPlane(GSD, tilt_deg, FOCAL, SIZE, SIZE, roll_deg)
    corners = np.array([(0, 0), (SIZE, 0), (SIZE, SIZE), (0, SIZE)], np.float32)
    ground = draw_court(TENNIS, GSD, degrees=25, side_px=2 * SIZE)
    there = plane.from_above(corners) + SIZE
    move = cv2.getPerspectiveTransform(there.astype(np.float32), corners)
    return cv2.warpPerspective(ground, move, (SIZE, SIZE), borderValue=(90, 90, 90)), plane


@pytest.mark.parametrize("tilt_deg", [15.0, 30.0, 45.0])
def test_the_shape_of_a_court_tells_where_the_camera_looked(tilt_deg: float) -> None:
    image, plane = _aside(tilt_deg)
    pose = Pose(SIZE / 2 - 4, SIZE / 2 + 3, np.radians(28), 1.05 / GSD)
    with open_raster(image) as raster:
        level = RectifiedRaster(raster, plane)
        middle = level.width_px / 2 + 0 * pose.x, level.height_px / 2
        assert level.in_image(np.array([middle])).shape == (1, 2)
        court = measure_court(level, Proposal(0, 0.9, _in_level(level, pose), 4))
        assert court is not None
        assert court.shape is not None
        moved = Court(**{**vars(court), "shape": level.in_image(court.shape)})
    found = tilt_posterior(court_cues([moved], SIZE, SIZE), Focal(FOCAL, 0.0))
    assert found is not None
    assert found.tilt_deg == pytest.approx(tilt_deg, abs=1)
    assert found.roll_deg == pytest.approx(4, abs=3)
    assert found.low_deg < tilt_deg < found.high_deg


def _in_level(level: RectifiedRaster, pose: Pose) -> Pose:
    """The same pose around the place where the image's centre lies in the view from above."""
    to_image = level._to_image
    x, y = cv2.perspectiveTransform(np.array([[[SIZE / 2, SIZE / 2]]], np.float64), np.linalg.inv(to_image))[0, 0]
    return Pose(float(x) - 4, float(y) + 3, pose.angle, pose.px_per_m)


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [20.0, 35.0])
def test_a_court_is_guessed_at_from_a_view_ten_degrees_off(tilt_deg: float) -> None:
    image, plane = _aside(tilt_deg)
    tried = GroundPlane(1.0, tilt_deg - 7, FOCAL, SIZE, SIZE)
    with open_raster(image) as raster:
        rough = rough_courts_on(raster, tried, NOTHING, made_card(4.6), most=3)
    tilts = [tilt_posterior([each], Focal(FOCAL, 0.0)) for each in court_cues(rough, SIZE, SIZE)]
    assert any(abs(each.tilt_deg - plane.tilt_deg) < 2 for each in tilts if each is not None)


def test_a_court_of_few_pixels_tells_nothing_of_a_tilt() -> None:
    corners = np.array([(0.0, 0.0), (80.0, 0.0), (80.0, 37.0), (0.0, 37.0)])
    assert court_cues([Court("tennis", corners, 23.77, 10.97, 0.3, 0.01, 0.9, 0.9, 0.0)], 200, 200) == []


@pytest.mark.parametrize(("tilt_deg", "followed"), [(2.0, 0), (15.0, 3)])
def test_a_guess_that_the_camera_looked_down_is_not_followed_as_the_image_was_searched_as_it_is(
    tilt_deg: float, followed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tilt_from_vehicles = tilt_posterior([GimbalCue(tilt_deg, 0.0, 0.3)], Focal(FOCAL, 0.0))
    searched: list[GroundPlane] = []

    def search(_: Any, plane: GroundPlane, *__: Any, **___: Any) -> tuple[Court, ...]:
        searched.append(plane)
        return ()

    corners = np.array([(100.0, 100), (200, 100), (200, 150), (100, 150)])
    rough = Court("tennis", corners, 23.77, 10.97, 0.2, 0.01, 0.5, 0.5, 0.2, shape=corners, shape_sd_px=1.0)
    monkeypatch.setattr(ruler, "rough_courts_on", lambda *_, **__: [rough])
    monkeypatch.setattr(ruler, "tilt_posterior", lambda *_: tilt_from_vehicles)
    monkeypatch.setattr(ruler, "find_courts_on", search)
    with open_raster(np.zeros((SIZE, SIZE, 3), np.uint8)) as raster:
        view = View(ImageFacts(SIZE, SIZE), NOTHING, made_card(4.6), ScaleOptions(), lambda *_: 1.0, raster)
        assert ruler.Courts()._found_tilted(view, raster) == ()
    assert len(searched) == followed
