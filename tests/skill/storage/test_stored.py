from __future__ import annotations

import json

import numpy as np
import pytest

from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import SceneCalibration, SceneLevel, SceneScalePrior
from vehanchor.flight.photograph import Look
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.records import Notice
from vehanchor.storage.stored import from_json, to_json


def _look() -> Look:
    scene = SceneScalePrior((SceneLevel(2, 9, np.linspace(-4, -1, 7)),), SceneCalibration(-4.6, 0.1))
    found = Detections(np.random.default_rng(1).normal(size=(4, 5)), np.linspace(0.1, 0.9, 4))
    facts = ImageFacts(10, 20, None, (Notice(code="a", message="b"),), CameraMetadata(make="x", height_m=3.0))
    return Look(facts, found, 0.7, prior=scene)


def test_findings_come_back_exactly() -> None:
    before = _look()
    after = from_json(json.loads(json.dumps(to_json(before))))
    assert isinstance(after, Look)
    assert after.image == before.image
    assert after.resolved == 0.7
    assert np.array_equal(after.detections.boxes, before.detections.boxes)
    assert after.detections.boxes.dtype == before.detections.boxes.dtype
    assert after.prior is not None
    assert before.prior is not None
    assert np.array_equal(after.prior.density, before.prior.density)
    after.detections.boxes[0] = 1  # and may be changed


@pytest.mark.parametrize(
    "stored",
    [
        {"=": "subprocess:Popen", "fields": {"args": "true"}},
        {"=": "vehanchor.storage.atomic:whole_file", "fields": {}},
        {"=": "vehanchor.errors:VehAnchorError", "fields": {}},
        {"=": "array", "dtype": "O", "shape": [1], "data": ""},
    ],
)
def test_a_journal_can_start_nothing(stored: object) -> None:
    with pytest.raises(ValueError, match="finding"):
        from_json(stored)


def test_what_is_no_finding_is_not_kept() -> None:
    with pytest.raises(TypeError, match="no finding"):
        to_json(object())
