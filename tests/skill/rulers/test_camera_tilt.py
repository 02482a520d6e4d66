from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card, measured, with_tilt
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import NOT_SEARCHED, Detections
from vehanchor.errors import TooObliqueError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera import Camera
from vehanchor.rulers.camera_tilt import CameraTilt, metadata_tilt, rectified
from vehanchor.rulers.height import GivenHeight
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.ruler import View
from vehanchor.scale.plane import GroundPlane
from vehanchor_flight.photograph import Photograph, StoredPhotograph, photograph_codec
from vehanchor_flight.pooling import pool

WIDTH = 3000
HEIGHT = 2000
FOCAL = 2400.0
CAR_M = 5.0
GSD = 0.05
CAR_WIDTH_M = CAR_M / 2.21  # as detectors draw it
CAMERA = CameraMetadata(
    focal_px=FOCAL, taken_width_px=WIDTH, taken_height_px=HEIGHT, off_nadir_deg=35.0
)
FACTS = ImageFacts(WIDTH, HEIGHT, camera=CAMERA)


def _cars(tilt: CameraTilt, n: int = 60) -> Detections:
    """Cars of one length, any heading, all over the image, as the camera sees them."""
    rng = np.random.default_rng(7)
    plane = tilt.plane(FACTS, GSD)
    boxes = []
    for _ in range(n):
        x = rng.uniform(200, WIDTH - 200)
        y = rng.uniform(200, HEIGHT - 200)
        heading = rng.uniform(0, np.pi)
        along = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-along[1], along[0]])
        here = [(x, y), (x, y)]
        metres = plane.length(
            here - np.array([along, across]) / 2, here + np.array([along, across]) / 2
        )
        boxes.append((x, y, CAR_M / metres[0], CAR_WIDTH_M / metres[1], heading))
    return Detections(np.array(boxes), np.full(n, 0.8))


def test_cars_are_of_one_length_on_the_plane() -> None:
    tilt = CameraTilt(35.0, 20.0, focal_length_px=FOCAL, source="metadata")
    seen = _cars(tilt)
    assert seen.boxes[:, 2].max() > 1.6 * seen.boxes[:, 2].min()
    assert rectified(seen, tilt.plane(FACTS)).boxes[:, 2] == pytest.approx(CAR_M / GSD, rel=0.01)


def test_boxes_of_the_proportions_of_a_car_seen_from_above_are_of_one_length_on_the_plane() -> None:
    """The detector draws them so at 30 degrees (research/results/notes.md), whichever way the car points."""
    tilt = CameraTilt(30.0, 0.0, focal_length_px=FOCAL, source="metadata")
    middle = np.array([WIDTH, HEIGHT]) / 2
    step = tilt.plane(FACTS, GSD).length([middle, middle], middle + np.eye(2))
    across = [WIDTH / 2, HEIGHT / 2, 0.89 * CAR_M / step[0], 1.25 * CAR_WIDTH_M / step[1], 0.0]
    away = [WIDTH / 2, HEIGHT / 2, 1.05 * CAR_M / step[1], 0.88 * CAR_WIDTH_M / step[0], np.pi / 2]
    lengths = rectified(Detections(np.array([across, away]), np.ones(2)), tilt.plane(FACTS)).boxes[
        :, 2
    ]
    assert lengths == pytest.approx([CAR_M / GSD] * 2, rel=0.04)


def test_the_record_is_that_of_the_centre_and_tells_the_tilt() -> None:
    tilt = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
    view = with_tilt(
        View(
            FACTS,
            _cars(tilt),
            card=made_card(CAR_M),
            options=ScaleOptions(),
            measure_detail_share=lambda *_: 1.0,
        )
    )
    analysis = analyse_view(view)
    estimate = analysis.estimate
    assert estimate.gsd_m_per_px == pytest.approx(GSD, rel=0.05)
    assert estimate.tilt is not None
    assert estimate.gsd_m_per_px is not None
    assert estimate.tilt.source == "metadata"
    assert estimate.tilt.tilt_deg == pytest.approx(35, abs=2)
    assert estimate.tilt.tilt_ci95_low_deg < 35 < estimate.tilt.tilt_ci95_high_deg
    assert estimate.tilt.gsd_least_m_per_px is not None
    assert estimate.tilt.gsd_largest_m_per_px is not None
    assert (
        estimate.tilt.gsd_least_m_per_px
        < estimate.gsd_m_per_px
        < estimate.tilt.gsd_largest_m_per_px
    )
    # for pictures, as they are
    assert np.array_equal(analysis.detections.boxes, view.detections.boxes)
    ignored = analyse_view(
        with_tilt(replace(view, options=ScaleOptions.of({"metadata": False})))
    ).estimate
    assert ignored.tilt is None


def _cars_and_parts() -> tuple[View, GroundPlane]:
    """A view of cars and of twice as many halves of them, without the camera's height, and its plane."""
    tilt = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
    cars = _cars(tilt, n=20).boxes
    parts = _cars(tilt, n=40).boxes * [1, 1, 0.5, 0.5, 1]
    boxes = np.concatenate([cars, parts])
    seen = Detections(boxes, np.full(len(boxes), 0.8), reductions=np.ones(len(boxes)))
    return View(
        FACTS,
        seen,
        card=made_card(CAR_M),
        options=ScaleOptions(),
        measure_detail_share=lambda *_: 1.0,
    ), tilt.plane(FACTS, GSD)


def test_the_height_of_the_camera_tells_cars_from_their_parts() -> None:
    view, plane = _cars_and_parts()
    alone = analyse_view(with_tilt(view))
    assert alone.estimate.gsd_m_per_px == pytest.approx(2 * GSD, rel=0.05)
    said = replace(view, image=FACTS._replace(camera=replace(CAMERA, height_m=plane.height_m)))
    with_height = analyse_view(with_tilt(said))
    assert with_height.estimate.n_vehicles == pytest.approx(20, abs=4)
    assert with_height.estimate.gsd_m_per_px == pytest.approx(GSD, rel=0.05)
    assert {each.kind for each in with_height.estimate.rulers if each.p_right > 0.5} == {
        "vehicles",
        "camera",
    }


def test_so_it_does_in_photographs_of_one_scale_put_together() -> None:
    view, plane = _cars_and_parts()
    image = FACTS._replace(camera=replace(CAMERA, height_m=plane.height_m))
    tilt = metadata_tilt(image, view.options)
    seen = [
        Photograph.of(
            name, StoredPhotograph(image, view.detections, 1.0, tilt=tilt), view.card, view.options
        )
        for name in ("a", "b")
    ]
    together = pool(seen, np.zeros(2), 0).estimate
    assert together.n_vehicles == pytest.approx(40, abs=8)
    assert together.gsd_m_per_px == pytest.approx(GSD, rel=0.05)


@pytest.mark.parametrize(
    "camera",
    [
        None,
        replace(CAMERA, off_nadir_deg=None),
        replace(CAMERA, off_nadir_deg=9.9),
        replace(CAMERA, taken_width_px=4000),
    ],
)
def test_without_tilt_or_of_a_crop_there_is_no_plane(camera: CameraMetadata | None) -> None:
    assert metadata_tilt(FACTS._replace(camera=camera), ScaleOptions()) is None


def test_of_a_crop_of_such_a_picture_a_warning_says_so() -> None:
    cars = _cars(CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata"))

    def codes(camera: CameraMetadata) -> list[str]:
        view = View(
            FACTS._replace(camera=camera),
            cars,
            card=made_card(CAR_M),
            options=ScaleOptions(),
            measure_detail_share=lambda *_: 1.0,
        )
        return [each.code for each in analyse_view(with_tilt(view)).estimate.warnings]

    crop = replace(CAMERA, taken_width_px=4000)
    assert "tilt_suspected" in codes(crop)
    assert "tilt_suspected" not in codes(replace(crop, off_nadir_deg=5.0))


def test_a_focal_length_that_nobody_tells_is_that_of_most_drones_and_the_source_says_so() -> None:
    tilt = metadata_tilt(FACTS._replace(camera=replace(CAMERA, focal_px=None)), ScaleOptions())
    assert tilt is not None
    assert tilt.source == "metadata; focal length unknown"
    told = metadata_tilt(
        FACTS._replace(camera=replace(CAMERA, focal_px=None)),
        ScaleOptions.of({"focal_35mm": 26, "height_m": 90}),
    )
    assert told is not None
    assert told.source == "metadata"
    assert told.focal_length_px == pytest.approx(tilt.focal_length_px)


def test_a_horizon_in_sight_is_refused() -> None:
    with pytest.raises(TooObliqueError, match="horizon"):
        metadata_tilt(FACTS._replace(camera=replace(CAMERA, off_nadir_deg=70.0)), ScaleOptions())


# --- Rulers along the tilt
# -------------------------------------------------------------------------------------------

HIGH = replace(CAMERA, off_nadir_deg=30.0, height_m=60.0)
LOW = replace(CAMERA, off_nadir_deg=30.0)


def _view(camera: CameraMetadata, **options: object) -> View:
    """A view without cars."""
    facts = FACTS._replace(camera=camera)
    return with_tilt(
        View(
            facts,
            NOT_SEARCHED,
            card=made_card(),
            options=ScaleOptions.of(options),
            measure_detail_share=lambda *_: 1.0,
        )
    )


def test_the_height_of_the_camera_is_measured_along_the_tilt() -> None:
    for tilt_deg in (30.0, 33.0):
        found = measured(Camera(), _view(replace(HIGH, off_nadir_deg=tilt_deg)))
        plane = GroundPlane(1.0, tilt_deg, focal_px=FOCAL, width_px=WIDTH, height_px=HEIGHT)
        assert found.gsd_m_per_px == pytest.approx(60 / plane.height_m)
    nadir = measured(Camera(), _view(replace(HIGH, off_nadir_deg=None)))
    assert nadir.gsd_m_per_px == pytest.approx(60 / FOCAL)


def test_lines_and_heights_of_the_caller_are_measured_along_the_tilt() -> None:
    plane = GroundPlane(GSD, 35.0, focal_px=FOCAL, width_px=WIDTH, height_px=HEIGHT, roll_deg=5.0)
    # near the camera: a third of the centre's metres a pixel
    ends = (100.0, HEIGHT - 60.0), (700.0, HEIGHT - 160.0)
    metres = float(plane.length([ends[0]], [ends[1]])[0])
    said = {"known_lengths": [(*ends[0], *ends[1], metres)], "height_m": plane.height_m}
    view = _view(LOW, **said).at_nadir()
    tilt = CameraTilt(35.0, 5.0, focal_length_px=FOCAL, source="metadata")
    for ruler in (KnownLengths(), GivenHeight()):
        before = measured(ruler, view)
        moved = measured(ruler, replace(view, tilt=tilt))
        assert before.gsd_m_per_px is not None
        assert before.interval is not None
        assert abs(before.gsd_m_per_px / GSD - 1) > 0.15
        assert moved.gsd_m_per_px == pytest.approx(GSD, rel=1e-6)
        assert moved.interval is not None
        assert moved.interval.high / moved.interval.low > before.interval.high / before.interval.low
        assert moved.statement is not None
        assert moved.statement.endswith("This is the scale of the image's centre.")
    record = analyse_view(_view(LOW, **said)).estimate
    # the metadata have 30 degrees, and no roll
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.1)
    assert [ruler.p_right > 0.5 for ruler in record.rulers] == [True, True]


def test_a_journal_keeps_the_tilt_and_what_was_measured_along_it() -> None:
    view = _view(HIGH)
    analysis = analyse_view(view)
    kept = photograph_codec().load(photograph_codec().dump(StoredPhotograph.of(view, analysis)))
    again = Photograph.of("a", kept, view.card, view.options).analysis.estimate
    assert again == analysis.estimate
    assert again.tilt is not None
    assert again.tilt.tilt_deg == 30.0
