from __future__ import annotations

import json
from typing import NamedTuple

import numpy as np
import pytest

from vehanchor.analysis.stored import stored_classes
from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import SceneCalibration, SceneLevel, SceneScalePrior
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.options import ScaleOptions
from vehanchor.rulers.given_height import GivenHeight
from vehanchor.rulers.point import assumed, point_witness, prior_witness
from vehanchor.scale.density import flat, lognormal
from vehanchor.scale.posterior import Mark, Witness
from vehanchor.scale.reliability import Shared
from vehanchor.storage.codec import Codec
from vehanchor_flight.photograph import StoredPhotograph, photograph_codec


def _stored() -> StoredPhotograph:
    scene = SceneScalePrior((SceneLevel(2, 9, np.linspace(-4, -1, 7)),), SceneCalibration(-4.6, 0.1))
    found = Detections(np.random.default_rng(1).normal(size=(4, 5)), np.linspace(0.1, 0.9, 4))
    facts = ImageFacts(10, 20, None, (RasterNote("a", "b"),), CameraMetadata(make="x", height_m=3.0))
    return StoredPhotograph(facts, found, 0.7, prior=scene)


def test_intermediate_results_come_back_exactly() -> None:
    before = _stored()
    after = photograph_codec().load(json.loads(json.dumps(photograph_codec().dump(before))))
    assert isinstance(after, StoredPhotograph)
    assert after.image == before.image
    assert after.resolved == 0.7
    assert np.array_equal(after.detections.boxes, before.detections.boxes)
    assert after.detections.boxes.dtype == before.detections.boxes.dtype
    assert after.prior is not None
    assert before.prior is not None
    assert np.array_equal(after.prior.density, before.prior.density)
    after.detections.boxes[0] = 1  # and may be changed


@pytest.mark.parametrize(
    "found",
    [
        {"=": "subprocess:Popen", "fields": {"args": "true"}},
        {"=": "vehanchor_flight.photograph:StoredPhotograph", "fields": {}},
        {"=": "array", "dtype": "O", "shape": [1], "data": ""},
    ],
)
def test_a_journal_can_start_nothing(found: object) -> None:
    with pytest.raises(ValueError, match="stored"):
        photograph_codec().load(found)


def test_a_class_without_a_stored_name_is_refused() -> None:
    with pytest.raises(TypeError, match="ScaleOptions has no stored name"):
        photograph_codec().dump(ScaleOptions())


def test_a_class_may_be_renamed_and_its_journals_are_read() -> None:
    class OldName(NamedTuple):
        length: float

    class NewName(NamedTuple):
        length: float

    kept = json.dumps(Codec({"tests.line": OldName}).dump(OldName(2.5)))
    assert "OldName" not in kept
    found = Codec({"tests.line": NewName}).load(json.loads(kept))
    assert isinstance(found, NewName)
    assert found == NewName(2.5)


@pytest.mark.parametrize(
    "witness",
    [
        point_witness("camera", 0.1, 0.02, 0.05, "{}", shared=[Shared("lens", 0.03)], marks=[Mark(((1, 2),), "up")]),
        assumed(point_witness("height", 0.1, 0.1, 0.05, "{}")),
        prior_witness("scene_scale", lognormal(0.1, 0.2), 0.7, 24),
        Witness("courts", n=0),
    ],
    ids=lambda witness: witness.kind,
)
def test_all_witnesses_of_the_rulers_can_be_stored(witness: Witness) -> None:
    codec = Codec(stored_classes())
    found = codec.load(json.loads(json.dumps(codec.dump(witness))))
    assert type(found) is Witness
    assert found.interval == witness.interval
    assert (found.shared, found.marks, found.assumed) == (witness.shared, witness.marks, witness.assumed)
    assert [lack.reason for lack in found.lacks] == [lack.reason for lack in witness.lacks]
    assert np.array_equal(found.density, witness.density)
    assert np.array_equal(found.wrong, flat())


def test_a_witness_that_a_ruler_declares_can_be_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    class Widths(Witness):
        """Witness of a ruler's own."""

    monkeypatch.setattr(GivenHeight, "stored_classes", {"tests.widths": Widths})
    codec = Codec(stored_classes())
    assert isinstance(codec.load(codec.dump(Widths("height", n=0))), Widths)
