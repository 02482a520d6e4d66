"""Tilted cameras: the ground plane, and rulers that measure along it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card, measured, with_tilt
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import NOT_SEARCHED, Detections
from vehanchor.detection.detector_errors import BoxErrors, DetectorErrors
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
from vehanchor.scale.posterior import Witness
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
    lengths = rectified(seen, tilt.plane(FACTS), DetectorErrors()).boxes[:, 2]
    assert lengths == pytest.approx(CAR_M / GSD, rel=0.01)


def test_boxes_with_the_proportions_of_nadir_have_one_length_on_the_plane() -> None:
    """The detector draws them so at 30 degrees, whichever way the car points.

    See research/results/notes.md.
    """
    tilt = CameraTilt(30.0, 0.0, focal_length_px=FOCAL, source="metadata")
    middle = np.array([WIDTH, HEIGHT]) / 2
    step = tilt.plane(FACTS, GSD).length([middle, middle], middle + np.eye(2))
    across = [WIDTH / 2, HEIGHT / 2, 0.89 * CAR_M / step[0], 1.25 * CAR_WIDTH_M / step[1], 0.0]
    away = [WIDTH / 2, HEIGHT / 2, 1.05 * CAR_M / step[1], 0.88 * CAR_WIDTH_M / step[0], np.pi / 2]
    detections = Detections(np.array([across, away]), np.ones(2))
    lengths = rectified(detections, tilt.plane(FACTS), DetectorErrors()).boxes[:, 2]
    assert lengths == pytest.approx([CAR_M / GSD] * 2, rel=0.04)


@pytest.fixture(scope="module")
def tilted_view() -> View:
    """Cars seen by a camera with a tilt of 35 degrees."""
    tilt = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
    view = View(
        FACTS,
        _cars(tilt),
        card=made_card(CAR_M),
        options=ScaleOptions(),
        measure_detail_share=lambda *_: 1.0,
    )
    return with_tilt(view)


@pytest.fixture(scope="module")
def tilted(tilted_view: View) -> ScaleAnalysis:
    """Analysis of the tilted view."""
    return analyse_view(tilted_view)


def test_the_scale_is_that_of_the_centre(tilted: ScaleAnalysis) -> None:
    assert tilted.estimate.gsd_m_per_px == pytest.approx(GSD, rel=0.05)


def test_the_record_states_the_tilt(tilted: ScaleAnalysis) -> None:
    tilt = tilted.estimate.tilt
    assert tilt is not None
    assert tilt.source == "metadata"
    assert tilt.tilt_deg == pytest.approx(35, abs=2)
    assert tilt.tilt_ci95_low_deg < 35 < tilt.tilt_ci95_high_deg


def test_the_record_has_the_range_of_scales(tilted: ScaleAnalysis) -> None:
    gsd = tilted.estimate.gsd_m_per_px
    tilt = tilted.estimate.tilt
    assert gsd is not None
    assert tilt is not None
    assert tilt.gsd_least_m_per_px is not None
    assert tilt.gsd_largest_m_per_px is not None
    assert tilt.gsd_least_m_per_px < gsd < tilt.gsd_largest_m_per_px


def test_pictures_show_the_boxes_of_the_image(tilted: ScaleAnalysis, tilted_view: View) -> None:
    assert np.array_equal(tilted.detections.boxes, tilted_view.detections.boxes)


def test_without_metadata_there_is_no_tilt(tilted_view: View) -> None:
    view = replace(tilted_view, options=ScaleOptions.of({"metadata": False}))
    assert analyse_view(with_tilt(view)).estimate.tilt is None


def _cars_and_parts(reach: float = 0.0) -> tuple[View, GroundPlane]:
    """Cars and twice as many halves of them, without the camera's height; and the ground plane.

    The logs of the cars' lengths differ by up to ``reach`` from their mean.
    """
    tilt = CameraTilt(35.0, 0.0, focal_length_px=FOCAL, source="metadata")
    cars = _cars(tilt, n=20).boxes
    cars[:, 2:4] *= np.exp(np.linspace(-reach, reach, 20))[:, None]
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


def test_the_height_of_the_camera_separates_cars_from_their_parts() -> None:
    # Equal cars would be doubted as look-alikes.
    view, plane = _cars_and_parts(reach=0.12)
    alone = analyse_view(with_tilt(view))
    assert alone.estimate.gsd_m_per_px == pytest.approx(2 * GSD, rel=0.05)
    image = FACTS._replace(camera=replace(CAMERA, height_m=plane.height_m))
    with_height = analyse_view(with_tilt(replace(view, image=image)))
    assert with_height.estimate.n_vehicles == pytest.approx(20, abs=4)
    assert with_height.estimate.gsd_m_per_px == pytest.approx(GSD, rel=0.05)
    assert {each.kind for each in with_height.estimate.rulers if each.p_right > 0.5} == {
        "vehicles",
        "camera",
    }


def test_the_height_separates_cars_from_parts_in_pooled_photographs() -> None:
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
def test_there_is_no_plane_of_a_crop_or_without_a_tilt(camera: CameraMetadata | None) -> None:
    assert metadata_tilt(FACTS._replace(camera=camera), ScaleOptions()) is None


def test_a_crop_of_a_tilted_photograph_gives_a_warning() -> None:
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


WITHOUT_LENS = FACTS._replace(camera=replace(CAMERA, focal_px=None))


def test_the_source_states_an_unknown_focal_length() -> None:
    tilt = metadata_tilt(WITHOUT_LENS, ScaleOptions())
    assert tilt is not None
    assert tilt.source == "metadata; focal length unknown"


def test_an_unknown_focal_length_is_that_of_most_drones() -> None:
    unknown = metadata_tilt(WITHOUT_LENS, ScaleOptions())
    stated = metadata_tilt(WITHOUT_LENS, ScaleOptions.of({"focal_35mm": 26, "height_m": 90}))
    assert unknown is not None
    assert stated is not None
    assert stated.source == "metadata"
    assert stated.focal_length_px == pytest.approx(unknown.focal_length_px)


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


def _stated_facts() -> dict[str, object]:
    """A line near the camera and a height, both true for a tilt of 35 degrees."""
    plane = GroundPlane(GSD, 35.0, focal_px=FOCAL, width_px=WIDTH, height_px=HEIGHT, roll_deg=5.0)
    # A pixel there has a third of the centre's metres.
    first = (100.0, HEIGHT - 60.0)
    second = (700.0, HEIGHT - 160.0)
    metres = float(plane.length([first], [second])[0])
    return {"known_lengths": [(*first, *second, metres)], "height_m": plane.height_m}


@pytest.fixture(params=[KnownLengths(), GivenHeight()], ids=lambda ruler: ruler.kind)
def at_nadir_then_tilted(request: pytest.FixtureRequest) -> tuple[Witness, Witness]:
    """A fact of the caller, measured as if at nadir and along the tilt."""
    view = _view(LOW, **_stated_facts()).at_nadir()
    tilt = CameraTilt(35.0, 5.0, focal_length_px=FOCAL, source="metadata")
    return measured(request.param, view), measured(request.param, replace(view, tilt=tilt))


def test_a_stated_fact_is_measured_along_the_tilt(
    at_nadir_then_tilted: tuple[Witness, Witness],
) -> None:
    at_nadir, tilted = at_nadir_then_tilted
    assert at_nadir.gsd_m_per_px is not None
    assert abs(at_nadir.gsd_m_per_px / GSD - 1) > 0.15
    assert tilted.gsd_m_per_px == pytest.approx(GSD, rel=1e-6)


def test_the_error_of_the_tilt_widens_the_interval_of_a_fact(
    at_nadir_then_tilted: tuple[Witness, Witness],
) -> None:
    at_nadir, tilted = at_nadir_then_tilted
    assert at_nadir.interval is not None
    assert tilted.interval is not None
    at_nadir_width = at_nadir.interval.high / at_nadir.interval.low
    assert tilted.interval.high / tilted.interval.low > at_nadir_width


def test_the_statement_of_a_fact_names_the_centre(
    at_nadir_then_tilted: tuple[Witness, Witness],
) -> None:
    _, tilted = at_nadir_then_tilted
    assert tilted.statement is not None
    assert tilted.statement.endswith("This is the scale of the image's centre.")


def test_stated_facts_agree_on_a_tilt_of_nearly_the_true_angle() -> None:
    record = analyse_view(_view(LOW, **_stated_facts())).estimate
    # the metadata have 30 degrees, and no roll
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.1)
    assert [ruler.p_right > 0.5 for ruler in record.rulers] == [True, True]


def test_a_journal_keeps_the_witnesses_of_a_tilted_view() -> None:
    view = _view(HIGH)
    analysis = analyse_view(view)
    kept = photograph_codec().load(photograph_codec().dump(StoredPhotograph.of(view, analysis)))
    again = Photograph.of("a", kept, view.card, view.options).analysis.estimate
    assert again == analysis.estimate
    assert again.tilt is not None
    assert again.tilt.tilt_deg == 30.0


def test_the_proportions_of_boxes_are_the_detectors() -> None:
    tilt = CameraTilt(35.0, 20.0, focal_length_px=FOCAL, source="metadata")
    errors = DetectorErrors(boxes=BoxErrors(length_over_width=2 * 2.21))
    before = rectified(_cars(tilt), tilt.plane(FACTS), DetectorErrors()).boxes
    after = rectified(_cars(tilt), tilt.plane(FACTS), errors).boxes
    # A quarter of the log length is that which the width implies.
    assert after[:, 2] == pytest.approx(2**0.25 * before[:, 2])
    assert after[:, 2] / after[:, 3] == pytest.approx(2 * 2.21)
