from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card, measured
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import equivalent_lens
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera import Camera
from vehanchor.rulers.given_height import GivenHeight
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.ruler import View
from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.camera_tilt import CameraTilt, metadata_tilt
from vehanchor_flight.photograph import Photograph, StoredPhotograph, photograph_codec

WIDTH, HEIGHT, GSD = 1000, 750, 0.08
FOCAL_PX = equivalent_lens(WIDTH, HEIGHT, 26.0).pixels
CAMERA = CameraMetadata(
    focal_px=FOCAL_PX, taken_width_px=WIDTH, taken_height_px=HEIGHT, off_nadir_deg=30.0, height_m=60.0
)


def _view(camera: CameraMetadata, **options: object) -> View:
    facts = ImageFacts(WIDTH, HEIGHT, camera=camera)
    nothing = Detections(np.zeros((0, 5)), np.zeros(0))
    view = View(facts, nothing, made_card(4.5), ScaleOptions.of(options), lambda *_: 1.0)
    return replace(view, tilt=metadata_tilt(facts, view.options))


def test_the_height_of_the_camera_is_measured_along_the_tilt() -> None:
    for tilt_deg in (30.0, 33.0):
        found = measured(Camera(), _view(replace(CAMERA, off_nadir_deg=tilt_deg)))
        plane = GroundPlane(1.0, tilt_deg, FOCAL_PX, WIDTH, HEIGHT)
        assert found.gsd_m_per_px == pytest.approx(60 / plane.height_m)
    nadir = measured(Camera(), _view(replace(CAMERA, off_nadir_deg=None)))
    assert nadir.gsd_m_per_px == pytest.approx(60 / FOCAL_PX)


def test_lines_and_heights_of_the_caller_are_measured_along_the_tilt() -> None:
    plane = GroundPlane(GSD, 35.0, FOCAL_PX, WIDTH, HEIGHT, 5.0)
    ends = (100.0, HEIGHT - 60.0), (700.0, HEIGHT - 160.0)  # near the camera: a third of the centre's metres a pixel
    metres = float(plane.length([ends[0]], [ends[1]])[0])
    said = {"known_lengths": [(*ends[0], *ends[1], metres)], "height_m": plane.height_m}
    view = _view(replace(CAMERA, height_m=None), **said).at_nadir()
    tilt = CameraTilt(35.0, 5.0, FOCAL_PX, "metadata")
    for ruler in (KnownLengths(), GivenHeight()):
        before, moved = measured(ruler, view), measured(ruler, replace(view, tilt=tilt))
        assert before.gsd_m_per_px is not None
        assert before.interval is not None
        assert abs(before.gsd_m_per_px / GSD - 1) > 0.15
        assert moved.gsd_m_per_px == pytest.approx(GSD, rel=1e-6)
        assert moved.interval is not None
        assert moved.interval.high / moved.interval.low > before.interval.high / before.interval.low
        assert moved.said is not None
        assert moved.said.endswith("This is the scale of the image's centre.")
    record = analyse_view(_view(replace(CAMERA, height_m=None), **said)).estimate
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.1)  # the metadata have 30 degrees, and no roll
    assert [ruler.p_right > 0.5 for ruler in record.rulers] == [True, True]


def test_a_journal_keeps_the_tilt_and_what_was_measured_along_it() -> None:
    view = _view(CAMERA)
    analysis = analyse_view(view)
    kept = photograph_codec().load(photograph_codec().dump(StoredPhotograph.of(view, analysis)))
    again = Photograph.of("a", kept, view.card, view.options).analysis.estimate
    assert again == analysis.estimate
    assert again.tilt is not None
    assert again.tilt.tilt_deg == 30.0
