from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import vehanchor
from research.scenes import render_scene
from tests.analyses import made_card
from tests.skill.tilt.test_vehicle_cue import FOCAL_PX, HEIGHT, WIDTH, _cars
from vehanchor.analysis.pipeline import analyse_detections, analyse_view
from vehanchor.courts.court import Court
from vehanchor.courts.template import TENNIS
from vehanchor.detection.detections import Detections
from vehanchor.errors import TooObliqueError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.camera import Camera
from vehanchor.rulers.courts import Courts
from vehanchor.rulers.given_height import GivenHeight
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.measurement import with_tilt
from vehanchor.rulers.view import View
from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.camera_tilt import CameraTilt, metadata_tilt
from vehanchor.tilt.estimate import estimate_tilt
from vehanchor_flight.photograph import Photograph, StoredPhotograph, photograph_codec
from vehanchor_flight.pooling import pool

CAMERA = CameraMetadata(focal_px=FOCAL_PX, taken_width_px=WIDTH, taken_height_px=HEIGHT, off_nadir_deg=30.0)
NOTHING = Detections(np.zeros((0, 5)), np.zeros(0))
GSD = 0.08


def _view(detections: Detections, camera: CameraMetadata | None = None, written: float | None = None) -> View:
    facts = ImageFacts(WIDTH, HEIGHT, camera=camera, georeference_gsd_m_per_px=written)
    return View(facts, detections, made_card(4.5), ScaleOptions(), lambda *_: 1.0)


def _estimated(view: View, courts: tuple[Court, ...] = ()) -> CameraTilt | None:
    """The tilt of a view by its metadata, its vehicles and courts."""
    cues = Courts().tilt_cues(courts, view.image)
    stated = metadata_tilt(view.image, view.options)
    return estimate_tilt(stated, cues, view.image, view.options, view.detections)


def _court(tilt_deg: float, roll_deg: float = 0.0, sd_px: float = 0.2) -> tuple[tuple[Court, ...], GroundPlane]:
    """A court anywhere on the plane, with corners where the camera sees them."""
    plane = GroundPlane(GSD, tilt_deg, FOCAL_PX, WIDTH, HEIGHT, roll_deg)
    frame = np.array([(0, 0), (WIDTH, 0), (WIDTH, HEIGHT), (0, HEIGHT)], np.float32)
    move = cv2.getPerspectiveTransform(plane.from_above(frame).astype(np.float32), frame)
    angle = np.radians(35)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    above = TENNIS.outline @ turn / GSD + (60, -90)
    corners = cv2.perspectiveTransform(above[None], move.astype(np.float64))[0]
    size = TENNIS.length_m, TENNIS.width_m
    return (Court("tennis", corners, *size, GSD, 0.002, 0.9, 0.9, 0.01, corners, sd_px),), plane


def test_metadata_alone_are_taken_as_they_are() -> None:
    view = _view(NOTHING, CAMERA)
    said = metadata_tilt(view.image, view.options)
    assert _estimated(view) == said


def test_cars_mend_a_gimbal_that_is_a_little_off() -> None:
    off = []
    for seed in range(4):
        view = _view(_cars(33.0, n=150, seed=seed), CAMERA)
        tilt = _estimated(view)
        assert tilt is not None
        assert tilt.source == "metadata, vehicles"
        assert tilt.interval_deg is not None
        assert tilt.interval_deg[0] < tilt.tilt_deg < tilt.interval_deg[1]
        off.append(abs(tilt.tilt_deg - 33))
    assert np.median(off) < 2.5


def test_a_gimbal_is_not_pulled_far_by_cars_of_two_sizes() -> None:
    cars = _cars(30.0, n=80, lorries=0)
    boxes = cars.boxes.copy()
    boxes[boxes[:, 1] < HEIGHT / 2, 2:4] *= 1.3
    view = _view(Detections(boxes, cars.scores), CAMERA)
    tilt = _estimated(view)
    assert tilt is not None
    assert tilt.tilt_deg == pytest.approx(30, abs=5)


@pytest.mark.parametrize("tilt_deg", [20.0, 30.0, 45.0])
def test_a_court_alone_tells_where_the_camera_tilt(tilt_deg: float) -> None:
    courts, _ = _court(tilt_deg, roll_deg=6.0)
    lens = replace(CAMERA, off_nadir_deg=None)
    tilt = _estimated(_view(NOTHING, lens), courts)
    assert tilt is not None
    assert tilt.source == "courts"
    assert tilt.tilt_deg == pytest.approx(tilt_deg, abs=1)
    assert tilt.roll_deg == pytest.approx(6, abs=2)
    unknown = _estimated(_view(NOTHING), courts)
    assert unknown is not None
    assert unknown.source == "courts; focal length unknown"
    assert unknown.tilt_deg == pytest.approx(tilt_deg, abs=4)


def test_a_court_seen_from_above_leaves_the_ground_level() -> None:
    courts, _ = _court(0.0)
    assert _estimated(_view(NOTHING), courts) is None
    aside, _ = _court(30.0)
    assert _estimated(_view(NOTHING, replace(CAMERA, off_nadir_deg=0.0)), aside) is None
    assert _estimated(_view(NOTHING, written=GSD), aside) is None


def test_the_height_of_the_camera_is_measured_along_the_joint_tilt() -> None:
    view = _view(NOTHING, replace(CAMERA, height_m=60.0))
    said = Camera().measure(view)
    moved = Camera().measure(replace(view, tilt=CameraTilt(33.0, 0.0, FOCAL_PX, "metadata, vehicles")))
    assert moved.gsd_m_per_px == pytest.approx(60 / GroundPlane(1.0, 33.0, FOCAL_PX, WIDTH, HEIGHT).height_m)
    assert said.gsd_m_per_px is not None
    assert moved.gsd_m_per_px is not None
    assert moved.gsd_m_per_px > said.gsd_m_per_px


def test_the_height_of_a_camera_that_does_not_say_where_it_tilt_is_measured_along_what_courts_say() -> None:
    view = _view(NOTHING, replace(CAMERA, off_nadir_deg=None, height_m=60.0))
    said = Camera().measure(view)
    moved = Camera().measure(replace(view, tilt=CameraTilt(33.0, 0.0, FOCAL_PX, "courts")))
    assert said.gsd_m_per_px == pytest.approx(60 / FOCAL_PX)
    assert moved.gsd_m_per_px == pytest.approx(60 / GroundPlane(1.0, 33.0, FOCAL_PX, WIDTH, HEIGHT).height_m)


def test_lines_and_heights_of_the_caller_are_measured_along_the_tilt() -> None:
    plane = GroundPlane(GSD, 35.0, FOCAL_PX, WIDTH, HEIGHT, 5.0)
    ends = (100.0, HEIGHT - 60.0), (700.0, HEIGHT - 160.0)  # near the camera: a third of the centre's metres a pixel
    metres = float(plane.length([ends[0]], [ends[1]])[0])
    said = {"known_lengths": [(*ends[0], *ends[1], metres)], "height_m": plane.height_m}
    view = replace(_view(NOTHING, CAMERA), options=ScaleOptions.of(said))
    tilt = CameraTilt(35.0, 5.0, FOCAL_PX, "metadata")
    for ruler in (KnownLengths(), GivenHeight()):
        before, moved = ruler.measure(view), ruler.measure(replace(view, tilt=tilt))
        assert before.gsd_m_per_px is not None
        assert before.interval is not None
        assert abs(before.gsd_m_per_px / GSD - 1) > 0.15
        assert moved.gsd_m_per_px == pytest.approx(GSD, rel=1e-6)
        assert moved.interval is not None
        assert moved.interval.high / moved.interval.low > before.interval.high / before.interval.low
        assert moved.said is not None
        assert moved.said.endswith("This is the scale of the image's centre.")
    record = analyse_detections(view).estimate
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.1)  # the metadata have 30 degrees, and no roll
    assert [ruler.p_right > 0.5 for ruler in record.rulers] == [True, True]


def test_a_tilt_that_a_court_cannot_tell_from_a_horizon_is_refused() -> None:
    courts, _ = _court(52.0)
    with pytest.raises(TooObliqueError, match="horizon"):
        _estimated(_view(NOTHING), courts)


def test_a_court_beside_the_centre_says_the_scale_of_the_centre() -> None:
    courts, plane = _court(35.0)
    tilt = CameraTilt(plane.tilt_deg, plane.roll_deg, plane.focal_px, "courts")
    view = replace(_view(NOTHING), tilt=tilt, found={"courts": courts})
    assert Courts().measure(view).gsd_m_per_px == pytest.approx(GSD, rel=1e-3)
    assert Courts().measure(view.at_nadir()).gsd_m_per_px == pytest.approx(GSD)


def test_a_journal_keeps_the_tilt_and_what_was_measured_along_it(monkeypatch: pytest.MonkeyPatch) -> None:
    courts, _ = _court(35.0)
    monkeypatch.setattr(Courts, "find", lambda *_: courts)
    view = with_tilt(_view(NOTHING))
    analysis = analyse_view(view)
    kept = photograph_codec().load(photograph_codec().dump(StoredPhotograph.of(view, analysis)))
    again = Photograph.of("a", kept, view.card, view.options).analysis.estimate
    assert again == analysis.estimate
    assert again.tilt is not None


def test_the_record_has_the_plane_and_gives_it_back_with_the_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    courts, plane = _court(35.0)
    monkeypatch.setattr(Courts, "find", lambda *_: courts)
    record = analyse_detections(_view(NOTHING, replace(CAMERA, off_nadir_deg=None))).estimate
    assert record.tilt is not None
    assert record.tilt.source == "courts"
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.01)
    known = record.model_copy(update={"scale": None}).scale
    assert known is None
    monkeypatch.setattr(Courts, "find", lambda *_: _court(0.0)[0])
    level = analyse_detections(_view(NOTHING)).estimate
    assert level.tilt is None
    assert plane.tilt_deg == pytest.approx(record.tilt.tilt_deg, abs=1)


def test_cars_of_many_photographs_put_together_say_nothing_of_a_tilt() -> None:
    views = [_view(_cars(35.0, seed=seed)) for seed in range(2)]
    photographs = [StoredPhotograph(view.image, view.detections, 1.0, ()) for view in views]
    seen = [
        Photograph.of("a", stored, view.card, view.options) for stored, view in zip(photographs, views, strict=True)
    ]
    assert all("tilt_suspected" in _codes(each.analysis.estimate) for each in seen)
    assert "tilt_suspected" not in _codes(pool(seen, np.zeros(2), 0).estimate)


def _codes(record: GsdEstimate) -> list[str]:
    return [notice.code for notice in record.warnings]


@pytest.mark.slow
def test_a_scale_that_is_given_back_measures_on_the_same_plane() -> None:
    ground = render_scene(0.1, width_px=1000, height_px=1000, seed=5009, layout="sports").image
    plane = GroundPlane(0.1, 30.0, 600.0, 800, 600)
    frame = np.array([(0, 0), (800, 0), (800, 600), (0, 600)], np.float32)
    above = plane.from_above(frame)
    there = above - (above.min(axis=0) + above.max(axis=0)) / 2 + 500
    move = cv2.getPerspectiveTransform(there.astype(np.float32), frame)
    image = cv2.warpPerspective(ground, move, (800, 600), borderMode=cv2.BORDER_REFLECT_101)
    record = vehanchor.estimate_gsd(image, rulers=("courts",))
    assert record.tilt is not None
    assert record.tilt.source == "courts; focal length unknown"
    assert record.tilt.tilt_deg == pytest.approx(30, abs=4)
    assert record.scale is not None
    assert record.scale.plane is not None
    ends = [(100.0, 100.0), (500.0, 120.0)]
    first = vehanchor.measure_distance(image, ends, rulers=("courts",))
    again = vehanchor.measure_distance(image, ends, scale=record.scale.model_dump())
    true = float(plane.length([ends[0]], [ends[1]])[0])
    assert first.distance_m == pytest.approx(true, rel=0.04)
    assert again.distance_m == pytest.approx(first.distance_m)
