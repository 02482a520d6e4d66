"""Test the one scale of a film's first seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from research.scenes.render import render_scene
from tests.flight.ground import write_film
from tests.models import blank_image, car_park, fleet, paint_vehicles, write_detector
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError
from vehanchor.scale.plane import GroundPlane
from vehanchor_flight.estimate import journal_key
from vehanchor_flight.verbs import estimate_flight
from vehanchor_flight.video import sample_video

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_flight.records import FlightEstimate

SUBTITLE = "{number}\n00:00:0{second},000 --> 00:00:0{second},033\n{text}\n\n"


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """Write a detector of the painted cars, and open it."""
    return Detector(write_detector(tmp_path_factory.mktemp("film_detector") / "m.onnx"))


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """Write four seconds over a car park, straight down."""
    picture = np.ascontiguousarray(car_park(fleet(24))[:, :, ::-1])
    frames = [np.roll(picture, number, axis=1) for number in range(40)]
    return _written(tmp_path, frames)


def _written(folder: Path, frames: list[Any]) -> Path:
    path = folder / "film.avi"
    write_film(path, frames, codec="FFV1")  # exact: the detector reads what is painted
    return path


def _write_subtitles(film: Path, text: str) -> None:
    entries = [SUBTITLE.format(number=k + 1, second=k, text=text) for k in range(4)]
    film.with_suffix(".SRT").write_text("".join(entries))


def _scale(film: Path, detector: Detector, **keywords: Any) -> FlightEstimate:
    frames = sample_video(str(film), 1.0, first_s=2.0)
    return estimate_flight(frames, same_scale=True, detector=detector, **keywords)


def test_the_first_seconds_alone_are_used(film: Path) -> None:
    frames = list(sample_video(str(film), 1.0, first_s=2.0))
    assert len(frames) == 2
    assert len(list(sample_video(str(film), 1.0))) == 4


@pytest.mark.parametrize("first_s", [0.0, -1.0, float("nan")])
def test_a_number_of_seconds_that_is_not_above_zero_is_refused(film: Path, first_s: float) -> None:
    with pytest.raises(InvalidParameterError, match="first"):
        list(sample_video(str(film), 1.0, first_s=first_s))


def test_a_film_has_pixels_per_metre(film: Path, detector: Detector) -> None:
    record = _scale(film, detector)
    assert record.gsd_m_per_px is not None
    assert record.pixels_per_meter == pytest.approx(1 / record.gsd_m_per_px)


def test_photographs_of_several_scales_have_no_pixels_per_metre(
    film: Path, detector: Detector
) -> None:
    frames = sample_video(str(film), 1.0)
    assert estimate_flight(frames, detector=detector).pixels_per_meter is None


def test_the_subtitles_are_facts_of_the_camera(film: Path, detector: Detector) -> None:
    _write_subtitles(film, "[focal_len: 24.00] [rel_alt: 40.000 abs_alt: 145.2]")
    record = _scale(film, detector)
    kinds = {ruler.kind for ruler in record.components[0].pooled.rulers}
    assert "camera" in kinds


def test_subtitles_that_are_added_later_make_another_result(film: Path) -> None:
    before, _ = sample_video(str(film), 1.0, first_s=2.0)
    _write_subtitles(film, "[focal_len: 24.00] [rel_alt: 40.000 abs_alt: 145.2]")
    after, _ = sample_video(str(film), 1.0, first_s=2.0)
    assert before.name == after.name
    assert journal_key(before) != journal_key(after)


def test_the_subtitles_alone_make_no_film_usable(tmp_path: Path, detector: Detector) -> None:
    rng = np.random.default_rng(3)
    empty = rng.integers(90, 110, (360, 480, 3)).astype(np.uint8)
    film = _written(tmp_path, [empty] * 20)
    _write_subtitles(film, "[focal_len: 24.00] [rel_alt: 40.000 abs_alt: 145.2]")
    record = _scale(film, detector, rulers=("camera", "vehicles"))
    assert record.gsd_m_per_px is not None
    assert record.status == "low_confidence"


def test_a_film_with_a_tilted_gimbal_is_refused(film: Path, detector: Detector) -> None:
    _write_subtitles(film, "[focal_len: 24.00] [rel_alt: 40.0] [gb_pitch: -45.0 gb_roll: 0.0]")
    with pytest.raises(InvalidParameterError, match="tilted by 45 degrees"):
        _scale(film, detector)


def test_a_film_of_cars_that_grow_to_one_side_is_refused(
    tmp_path: Path, detector: Detector
) -> None:
    film = _written(tmp_path, [_oblique()] * 20)
    with pytest.raises(InvalidParameterError, match="grow to one side"):
        _scale(film, detector)


def _oblique() -> Any:
    """Paint 80 cars of one fleet as a camera sees them that is tilted by 40 degrees."""
    width, height = 1280, 960
    plane = GroundPlane(0.1, 40.0, focal_px=1000.0, width_px=width, height_px=height)
    rows, columns = np.mgrid[0:8, 0:10]
    places = np.column_stack([80 + 120 * columns.ravel(), 70 + 115 * rows.ravel()]).astype(float)
    rng = np.random.default_rng(0)
    sizes = np.exp(rng.normal(0, 0.05, len(places))) / plane.gsd_at(places)
    boxes = np.column_stack([places, 4.5 * sizes, 1.8 * sizes, rng.uniform(0, 3, len(places))])
    image = blank_image(width, height)
    paint_vehicles(image, boxes)
    return np.ascontiguousarray(image[:, :, ::-1])


def _run(*arguments: object) -> Any:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def test_the_command_prints_pixels_per_metre(film: Path, detector: Detector) -> None:
    done = _run(
        "flight", film, "--same-scale", "--first", "2", "--every", "1", "--detector", detector.path
    )
    assert done.exit_code == 0, done.output
    assert "pixels per metre" in done.stdout


def test_first_seconds_of_photographs_are_refused(tmp_path: Path) -> None:
    done = _run("flight", tmp_path, "--first", "2")
    assert done.exit_code == 2
    assert "--first is about a video" in done.stderr


FRAME = (640, 360)
RENDERED_GSD = 0.2


@pytest.fixture(scope="module")
def scene() -> Any:
    """Render a car park of known scale, BGR."""
    rendered = render_scene(RENDERED_GSD, width_px=1100, height_px=950, seed=1, layout="parking")
    return np.ascontiguousarray(rendered.image[:, :, ::-1])


def _film_of(scene: Any, folder: Path, tilt_deg: float) -> Path:
    """Film the scene for a second while the drone flies on, with a camera tilted by an angle."""
    frames = [
        cv2.warpPerspective(scene, _view(scene, tilt_deg, 3.0 * k), FRAME, flags=cv2.INTER_AREA)
        for k in range(10)
    ]
    return _written(folder, frames)


def _view(scene: Any, tilt_deg: float, moved_px: float) -> Any:
    """Make the homography from the ground to a frame with the scene's scale in its centre."""
    width, height = FRAME
    focal_px = 0.69 * width
    tilt = np.radians(tilt_deg)
    camera = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    across = (1.0, 0.0, 0.0)
    down = (0.0, np.cos(tilt), np.sin(tilt))
    # At this distance, a pixel of the ground is a pixel of the frame.
    centre = (0.0, 0.0, focal_px)
    to_centre = np.eye(3)
    to_centre[:2, 2] = (-scene.shape[1] / 2 - moved_px, -scene.shape[0] / 2)
    return camera @ np.column_stack([across, down, centre]) @ to_centre


def _rendered_scale(film: Path) -> FlightEstimate:
    return estimate_flight(sample_video(str(film), 0.5, first_s=1.0), same_scale=True)


@pytest.mark.slow
def test_a_rendered_film_has_its_scale(scene: Any, tmp_path: Path) -> None:
    record = _rendered_scale(_film_of(scene, tmp_path, 0.0))
    assert record.status == "ok"
    assert record.pixels_per_meter == pytest.approx(1 / RENDERED_GSD, rel=0.1)


@pytest.mark.slow
def test_its_oblique_twin_is_refused(scene: Any, tmp_path: Path) -> None:
    film = _film_of(scene, tmp_path, 30.0)
    with pytest.raises(InvalidParameterError, match="grow to one side"):
        _rendered_scale(film)


@pytest.mark.slow
def test_an_oblique_twin_with_few_cars_is_not_usable(scene: Any, tmp_path: Path) -> None:
    film = _film_of(scene, tmp_path, 45.0)
    assert _rendered_scale(film).status != "ok"
