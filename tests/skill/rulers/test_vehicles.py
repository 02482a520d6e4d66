from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import made_card
from vehanchor.analysis.pipeline import analyse_detections
from vehanchor.detection.appearance import FleetAppearance
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import Lengths, ScaleOptions
from vehanchor.records import Notice
from vehanchor.records.ruler_kinds import RULERS
from vehanchor.rulers.evidence import Evidence, View
from vehanchor.rulers.ruler import Ruler
from vehanchor.rulers.vehicles import Vehicles, select
from vehanchor.scale.fusion import Votes, credible_interval
from vehanchor.scale.lengths import Interval

_LENGTHS = [40.0, 41.0, 42.0, 40.0, 41.0, 90.0]


def _view(lengths: list[float], **options: Any) -> View:
    boxes = np.array([[99.0 * k, 50, length, 18, 0] for k, length in enumerate(lengths)]).reshape(-1, 5)
    found = Detections(boxes, np.full(len(boxes), 0.8))
    return View(ImageFacts(800, 600), found, made_card(5.0), ScaleOptions.of(options), lambda *_: 1.0)


def test_the_fleet_is_what_the_outlier_filter_leaves() -> None:
    fleet = select(_view(_LENGTHS).detections, Lengths())
    assert fleet.kept.tolist() == [True] * 5 + [False]
    assert fleet.lengths.tolist() == _LENGTHS[:5]
    assert (fleet.working_scale, fleet.appearance) == (1.0, None)


def test_vehicles_say_the_reference_length_over_their_modal_length() -> None:
    evidence = Vehicles().measure(_view(_LENGTHS))
    assert evidence.mode_length_px is not None
    assert evidence.gsd_m_per_px == 5.0 / evidence.mode_length_px == pytest.approx(5 / 40.8, rel=0.02)
    assert (evidence.kind, evidence.n) == ("vehicles", 5)


def test_no_vehicles_are_no_evidence() -> None:
    evidence = Vehicles().measure(_view([]))
    assert (evidence.gsd_m_per_px, evidence.interval, evidence.n, evidence.confidence) == (None, None, 0, 0.0)


class Shadow(Ruler):
    """A ruler that a stranger adds: it reads the facts of the image alone."""

    kind = "shadow"
    label = "shadow"
    help = "a shadow"

    def measure(self, view: View) -> Evidence:
        doubt = Notice(code="shadow_short", message="The shadow is short.")
        return Evidence(self.kind, 100 / view.image.width_px, Interval(0.1, 0.2), 1, 0.2, (doubt,))


def test_a_ruler_in_the_registry_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(RULERS, "shadow", f"{__name__}:Shadow")
    analysis = analyse_detections(_view(_LENGTHS, rulers=("vehicles", "shadow")))
    assert [(each.kind, each.gsd_m_per_px) for each in analysis.others] == [("shadow", 0.125)]
    assert [notice.code for notice in analysis.estimate.warnings] == ["shadow_short"]
    assert analysis.estimate.leading_ruler == "vehicles"  # without a density there is nothing to multiply
    assert analysis.estimate.gsd_m_per_px == analysis.vehicles.gsd_m_per_px


def test_the_appearance_of_the_kept_vehicles_is_what_was_asked_of_them() -> None:
    odds: NDArray[np.float64] = np.array([1.0, 2.0, 3.0])
    view = _view(_LENGTHS)
    found = Detections(view.detections.boxes[::-1], view.detections.scores, fleet=FleetAppearance(odds, odds / 2))
    fleet = select(found, Lengths())
    assert fleet.appearance is not None
    assert fleet.appearance.log_odds.tolist() == [2.0, 3.0]  # the longest comes first and is dropped
    assert fleet.appearance.log_lengths.tolist() == [1.0, 1.5]


def test_among_other_rulers_the_boxes_speak_around_the_papers_scale() -> None:
    votes = Votes(share_at_zero=-2.0, share_slope=6.0, log_sd=0.15, clutter_density=1.0, trust=0.6, chance_wrong=0.02)
    lengths = [*np.linspace(27, 33, 12), 40.0, 41.0, 42.0]  # a few long ones: mean and mode part
    view = _view(lengths)
    evidence = Vehicles().measure(replace(view, card=view.card.model_copy(update={"votes": votes})))
    assert evidence.density is not None
    assert evidence.fusable_density is not None
    assert evidence.gsd_m_per_px is not None
    own, among = (credible_interval(each, 0.0).low for each in (evidence.density, evidence.fusable_density))
    assert among == pytest.approx(evidence.gsd_m_per_px, rel=0.01)
    assert abs(among / evidence.gsd_m_per_px - 1) < abs(own / evidence.gsd_m_per_px - 1)
