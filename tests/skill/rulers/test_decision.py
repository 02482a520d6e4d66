"""The record's scale where several rulers speak: whose it is, how far it may be used, and who does not agree."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card
from tests.skill.rulers.test_camera import MAVIC
from vehanchor.analysis.pipeline import analyse_detections
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.rulers.decision import ScaleDecision, convergence, decide
from vehanchor.rulers.evidence import Evidence, View
from vehanchor.rulers.lognormal import lognormal
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.fusion import Votes, credible_interval

VOTES = Votes(
    share_at_zero=-2.0, share_slope=6.0, log_sd=0.12, clutter_density=0.3, trust=0.5, chance_wrong=0.05
)  # of a detector that there is not


def _record(
    cars: int,
    car_px: float = 50.0,
    *,
    camera: CameraMetadata | None = None,
    votes: Votes | None = VOTES,
    **options: Any,
) -> GsdEstimate:
    """Cars of 5 m and some pixels in an image of 4000 x 3000 px."""
    spread = np.exp(0.08 * np.linspace(-1.5, 1.5, cars)) if cars > 1 else np.ones(cars)
    boxes = np.array([[99.0 + 90 * k, 90, car_px * each, 0.4 * car_px, 0] for k, each in enumerate(spread)])
    found = Detections(boxes.reshape(-1, 5), np.full(cars, 0.8))
    card = made_card(5.0).model_copy(update={"votes": votes}) if votes else made_card(5.0)
    view = View(ImageFacts(4000, 3000, camera=camera), found, card, ScaleOptions.of(options), lambda *_: 1.0)
    return analyse_detections(view).estimate


def _limited(record: GsdEstimate) -> float:
    """The chance, limited as a planner needs it."""
    assert record.p_within_20 is not None
    return record.p_within_20 if record.p_within_20 >= 0.9 else min(record.p_within_20, 0.45)


@pytest.mark.parametrize("cars", [1, 2, 4, 5, 30])
def test_the_confidence_is_the_chance_for_any_number_of_cars(cars: int) -> None:
    record = _record(cars)
    assert record.confidence == _limited(record)
    assert (record.composite_confidence < 0.5) == (cars < 5)  # the paper's
    assert record.composite_confidence != record.confidence


def test_more_cars_that_agree_are_a_better_chance() -> None:
    chances = [_record(cars).p_within_20 or 0.0 for cars in (1, 2, 4, 30)]
    assert chances == sorted(set(chances))
    assert chances[0] < 0.9 < chances[-1]


def test_with_uncalibrated_votes_the_confidence_is_the_composite() -> None:
    record = _record(30, votes=None)
    assert record.p_within_20 is None
    assert record.confidence == record.composite_confidence >= 0.5


def test_the_guard_limits_the_chance() -> None:
    record = _record(300, car_px=12.0)
    assert record.p_within_20 is not None
    assert (record.confidence, record.reason) == (0.3, "too_coarse")


@pytest.mark.parametrize(("cars", "reason"), [(1, "too_few"), (4, "too_few"), (12, "imprecise")])
def test_the_reason_is_too_few_only_where_few_leave_a_doubt(cars: int, reason: str) -> None:
    loose = VOTES._replace(log_sd=0.4, clutter_density=1.0)
    record = _record(cars, votes=loose)
    assert record.p_within_20 is not None
    assert record.p_within_20 < 0.9
    assert (record.status, record.reason) == ("low_confidence", reason)


def _with_prior(cars: int, ratio: float) -> ScaleDecision:
    """Cars that say 0.1 m/px, and a prior that says so many times as much."""
    spread = np.exp(0.08 * np.linspace(-1.5, 1.5, cars)) if cars > 1 else np.ones(cars)
    boxes = np.array([[99.0 + 90 * k, 90, 50.0 * each, 20.0, 0] for k, each in enumerate(spread)])
    card = made_card(5.0).model_copy(update={"votes": VOTES})
    found = Detections(boxes, np.full(cars, 0.8))
    vehicles = Vehicles().measure(View(ImageFacts(4000, 3000), found, card, ScaleOptions(), lambda *_: 1.0))
    density = lognormal(0.1 * ratio, 0.15)
    prior = Evidence("scene_scale", 0.1 * ratio, credible_interval(density), 9, 0.0, (), density)
    return decide(vehicles, [prior])


def test_the_prior_moves_the_scale_of_few_cars_only() -> None:
    few, many = _with_prior(1, 1.15), _with_prior(30, 1.15)
    assert few.gsd_m_per_px is not None
    assert 0.103 < few.gsd_m_per_px < 0.112
    assert {ruler.kind: ruler.weight > 0.1 for ruler in few.rulers} == {"vehicles": True, "scene_scale": True}
    assert few.source == "vehicles"
    assert many.gsd_m_per_px == _with_prior(30, 1.0).gsd_m_per_px
    assert {ruler.kind: ruler.weight for ruler in many.rulers} == {"vehicles": 1.0, "scene_scale": 0.0}


def test_a_prior_far_off_moves_few_cars_by_a_quarter_at_most_and_makes_them_unusable() -> None:
    far = _with_prior(2, 3.0)
    assert far.gsd_m_per_px is not None
    assert 0.1 <= far.gsd_m_per_px <= 0.1 * math.exp(0.26)
    assert (far.confidence < 0.5, far.reason) == (True, "disagree")


def _line(gsd: float) -> list[tuple[Any, ...]]:
    return [(100, 100, 1100, 100, 1000 * gsd, "measured")]


@pytest.mark.parametrize("votes", [VOTES, None])
def test_cars_alone_are_the_papers_record_whatever_else_is_allowed(votes: Votes | None) -> None:
    every, alone = _record(30, votes=votes), _record(30, votes=votes, rulers=("vehicles",))
    assert every == alone
    assert every.gsd_m_per_px == every.reference_length_m / (every.mode_length_px or math.nan)
    assert every.leading_ruler == "vehicles"
    assert [(ruler.kind, ruler.weight, ruler.agrees) for ruler in every.rulers] == [("vehicles", 1.0, True)]


@pytest.mark.parametrize("votes", [VOTES, None])
def test_with_other_rulers_at_hand_the_paper_is_one_option_away(votes: Votes | None) -> None:
    heard = _record(30, votes=votes, camera=MAVIC, known_lengths=_line(0.09))
    paper = _record(30, votes=votes, camera=MAVIC, known_lengths=_line(0.09), rulers=("vehicles",))
    assert paper == _record(30, votes=votes)
    assert heard.gsd_m_per_px != paper.gsd_m_per_px
    assert (heard.n_vehicles, heard.mode_length_px) == (paper.n_vehicles, paper.mode_length_px)


@pytest.mark.parametrize("votes", [VOTES, None])
def test_a_line_of_one_per_cent_leads_over_the_cars(votes: Votes | None) -> None:
    record = _record(30, votes=votes, known_lengths=_line(0.093))
    assert record.leading_ruler == "known_length"
    assert record.gsd_m_per_px == pytest.approx(0.093, rel=0.01)
    assert record.status == "ok"
    assert all(ruler.agrees for ruler in record.rulers)
    assert sum(ruler.weight for ruler in record.rulers) == pytest.approx(1)


@pytest.mark.parametrize(
    ("options", "camera", "gsd", "source"),
    [
        ({"known_lengths": _line(0.05)}, None, 0.05, "known_length"),
        ({"height_m": 100.0, "focal_35mm": 26.0}, None, 0.0333, "height"),
        ({}, MAVIC, 0.0333, "camera"),
    ],
)
def test_without_a_car_the_other_ruler_makes_the_scale(
    options: dict[str, Any], camera: CameraMetadata | None, gsd: float, source: str
) -> None:
    record = _record(0, camera=camera, **options)
    assert record.gsd_m_per_px == pytest.approx(gsd, rel=0.05)
    assert record.leading_ruler == source
    assert (record.n_vehicles, record.mode_length_px, record.working_scale) == (0, None, None)
    assert record.confidence_terms.sample == 0
    low, high = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
    assert low is not None
    assert high is not None
    (ruler,) = record.rulers
    assert low == pytest.approx(ruler.gsd_ci95_low_m_per_px, rel=0.01)  # one ruler's interval is its own
    assert high == pytest.approx(ruler.gsd_ci95_high_m_per_px, rel=0.01)
    assert record.p_within_20 is not None
    assert (record.status == "ok") == (record.p_within_20 >= 0.9) == (record.confidence >= 0.5)


def test_a_precise_ruler_without_cars_is_safe_to_use_and_a_loose_one_is_not() -> None:
    assert _record(0, known_lengths=_line(0.05)).status == "ok"
    loose = _record(0, camera=replace(MAVIC, off_nadir_deg=None))
    assert (loose.status, loose.reason) == ("low_confidence", "imprecise")


def test_a_height_above_the_sea_alone_is_no_scale() -> None:
    record = _record(0, camera=replace(MAVIC, height_m=None, height_tag=""))
    assert (record.status, record.gsd_m_per_px, record.leading_ruler, record.rulers) == ("no_scale", None, None, ())


def test_one_liar_of_three_is_named_and_the_scale_stays_that_of_the_others() -> None:
    record = _record(40, car_px=5.0 / 0.033, camera=MAVIC, known_lengths=_line(0.2))
    assert record.gsd_m_per_px == pytest.approx(0.033, rel=0.1)
    assert {ruler.kind: ruler.agrees for ruler in record.rulers} == {
        "vehicles": True,
        "camera": True,
        "known_length": False,
    }
    (warning,) = record.warnings
    assert warning.code == "rulers_disagree"
    assert warning.message.startswith(
        "The known length says 0.2 m/px, and the other rulers disagree: the vehicles say 0.03"
    )


def test_two_rulers_far_apart_are_not_safe_to_use() -> None:
    record = _record(40, camera=MAVIC)  # the cars say 0.1, the camera 0.033
    assert (record.status, record.reason) == ("low_confidence", "disagree")
    assert record.confidence < 0.5
    assert [warning.code for warning in record.warnings] == ["rulers_disagree"]


@pytest.mark.parametrize("votes", [VOTES, None])
def test_cars_that_are_too_small_to_be_measured_do_not_outvote_a_line(votes: Votes | None) -> None:
    record = _record(300, car_px=12.0, votes=votes, known_lengths=_line(0.6))  # the cars say 0.42
    assert record.resolution_guard
    assert record.leading_ruler == "known_length"
    assert record.gsd_m_per_px == pytest.approx(0.6, rel=0.02)


def test_a_ruler_that_says_next_to_nothing_leaves_the_papers_scale_where_it_was() -> None:
    paper = _record(30)
    vague = _record(30, height_m=300.0, focal_35mm=26.0)  # 0.1 m/px, as the cars say
    assert vague.gsd_m_per_px == pytest.approx(paper.gsd_m_per_px, rel=0.02)


def test_rulers_without_vehicles_need_no_search(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    import vehanchor
    import vehanchor.analysis.pipeline as module
    from tests.models import blank_image, write_detector

    def _refuse(*_args: Any, **_kwargs: Any) -> Detections:
        raise AssertionError("the detector ran")

    monkeypatch.setattr(module, "search", _refuse)
    detector = str(write_detector(tmp_path / "detector.onnx"))
    options: dict[str, Any] = {"known_lengths": [(0, 0, 100, 0, 12.0)], "rulers": ("known_length",)}
    record = vehanchor.estimate_gsd(blank_image(200, 100), detector=detector, **options)
    assert record.gsd_m_per_px == pytest.approx(0.12, rel=0.01)
    assert record.n_detections == 0


def test_a_search_goes_on_while_more_cars_may_make_the_scale_usable() -> None:
    boxes = np.array([[99.0 + 60 * k, 90, 50 + 0.2 * (k % 9), 20, 0] for k in range(60)])
    seen = {}
    for sd_m in np.linspace(0.05, 1.5, 59):
        card = made_card(5.0).model_copy(update={"votes": VOTES, "reference_length_sd_m": float(sd_m)})
        found = Detections(boxes, np.full(60, 0.8))
        view = View(ImageFacts(4000, 3000), found, card, ScaleOptions(), lambda *_: 1.0)
        cars = Vehicles().measure(view)
        decision = decide(cars, ())
        assert decision.p_within_20 is not None
        seen[decision.p_within_20] = (decision.reason, convergence(cars, ()).doubted)
    usable = [told for chance, told in seen.items() if chance >= 0.9]
    close = [told for chance, told in seen.items() if 0.87 <= chance < 0.9]
    far = [told for chance, told in seen.items() if chance < 0.87]
    assert set(usable) == {(None, False)}
    assert set(close) == {("imprecise", True)}
    assert set(far) == {("imprecise", False)}
