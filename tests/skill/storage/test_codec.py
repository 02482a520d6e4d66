from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from types import ModuleType
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
from vehanchor.records.ruler_kinds import RULERS
from vehanchor.rulers import registry
from vehanchor.rulers.evidence import Evidence, Mark
from vehanchor.rulers.given_height import GivenHeight
from vehanchor.rulers.vehicles import VehicleEvidence
from vehanchor.scale.lengths import Interval
from vehanchor.storage.codec import Codec
from vehanchor_flight.photograph import StoredPhotograph, photograph_codec

for _kind in RULERS:
    registry.ruler_class(_kind)
_RULERS = {each.__name__ for each in vars(sys.modules["vehanchor.rulers"]).values() if isinstance(each, ModuleType)}
assert registry.__name__ in _RULERS


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


def test_a_stored_name_belongs_to_one_class() -> None:
    with pytest.raises(ValueError, match="one class each"):
        Codec({"mark": Mark, "line": Mark})


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


def test_all_evidence_of_the_rulers_can_be_stored() -> None:
    def below(kind: type[Evidence]) -> Iterator[type[Evidence]]:
        yield kind
        for each in kind.__subclasses__():
            yield from below(each)

    made_by_rulers = [kind for kind in below(Evidence) if kind is not VehicleEvidence and kind.__module__ in _RULERS]
    assert len(made_by_rulers) >= 2
    codec = Codec(stored_classes())
    for kind in made_by_rulers:
        found = codec.load(codec.dump(kind("height", 0.1, Interval(0.09, 0.11), 1, 0.9, ())))
        assert type(found) is kind
        assert found.interval == Interval(0.09, 0.11)


def test_evidence_that_a_ruler_declares_can_be_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    class Widths(Evidence):
        """Evidence of a ruler's own."""

    monkeypatch.setattr(GivenHeight, "stored_classes", {"tests.widths": Widths})
    codec = Codec(stored_classes())
    assert isinstance(codec.load(codec.dump(Widths("height", None, None, 0, 0.0, ()))), Widths)
