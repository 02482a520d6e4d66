"""The ruler that the documentation works through, put into the registry as it says: it makes a scale and is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card
from tests.conftest import ROOT
from tests.docs.documents import blocks
from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.detections import Detections, Objects
from vehanchor.estimate import analyse_detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.rulers.evidence import View

LENGTH_PX, GSD = 800.0, 176.91 / 800.0


@pytest.fixture
def track(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the how-to, registered under a name that options and records know already."""
    (text,) = (block.text for block in blocks(ROOT / "docs/how-to/rulers.md") if "class Track" in block.text)
    defined: dict[str, Any] = {"__name__": "track"}
    exec(compile(text, "track.py", "exec"), defined)
    ruler = defined["Track"]()
    assert ruler.kind == "track"
    ruler.kind = "courts"
    monkeypatch.setattr("vehanchor.estimate.OTHER_RULERS", (ruler,))
    return ruler


TILTED = CameraMetadata(focal_px=900.0, taken_width_px=1000, taken_height_px=800, off_nadir_deg=40.0)


def _analysed(
    width_px: float,
    name: str = "ground-track-field",
    score: float = 0.9,
    camera: CameraMetadata | None = None,
    **options: Any,
) -> ScaleAnalysis:
    seen = Objects(np.array([[500.0, 400.0, LENGTH_PX, width_px, 0.3]]), np.array([score]), np.array([1]))
    found = Detections(np.zeros((0, 5)), np.zeros(0), others=seen)
    card = made_card().model_copy(update={"class_names": {0: "small-vehicle", 1: name}})
    facts = ImageFacts(1000, 800, camera=camera)
    return analyse_detections(View(facts, found, card, ScaleOptions.of(options), lambda *_: 1.0))


def test_a_running_track_makes_the_scale_of_an_image_without_cars(track: Any) -> None:
    record = _analysed(LENGTH_PX * 92.52 / 176.91).estimate
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.005)
    assert (record.leading_ruler, record.n_vehicles) == (track.kind, 0)
    assert record.rulers[0].explanation is not None
    assert record.rulers[0].explanation.startswith("A running track of 800 px says 0.2211 m/px")


def test_its_outline_is_there_to_be_drawn(track: Any) -> None:
    (mark,) = _analysed(LENGTH_PX * 92.52 / 176.91).marks
    assert (mark.label, mark.closed, len(mark.points)) == ("176.91 m", True, 4)
    sides = [np.hypot(*np.subtract(mark.points[k], mark.points[k - 1])) for k in range(4)]
    assert max(sides) == pytest.approx(LENGTH_PX)


@pytest.mark.usefixtures("track")
@pytest.mark.parametrize("other", [{"width_px": 300.0}, {"name": "soccer-ball-field"}, {"score": 0.3}])
def test_another_field_is_no_ruler(other: dict[str, Any]) -> None:
    record = _analysed(**{"width_px": LENGTH_PX * 92.52 / 176.91, **other}).estimate
    assert (record.status, record.gsd_m_per_px) == ("no_scale", None)


@pytest.mark.xfail(strict=True, reason="a ruler is measured as if from straight above")
@pytest.mark.usefixtures("track")
def test_on_a_tilted_photograph_it_agrees_with_a_known_line_on_the_same_pixels() -> None:
    reach = LENGTH_PX / 2 * np.array([np.cos(0.3), np.sin(0.3)])
    ends = np.array([500.0, 400.0]) + [-reach, reach]
    record = _analysed(LENGTH_PX * 92.52 / 176.91, camera=TILTED, known_lengths=[(*ends.ravel(), 176.91)]).estimate
    said = {ruler.kind: ruler.gsd_m_per_px for ruler in record.rulers}
    assert said.pop("known_length") == pytest.approx(said.popitem()[1], rel=0.01)
