"""Vehicles as a ruler: doubts about the fleet, weaknesses, and the reference length."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.analyses import log_sd, made_card
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.detector import load_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Reference, ScaleOptions
from vehanchor.rulers.reference import country_in_words, reference_length, unmeasured_region
from vehanchor.rulers.ruler import View
from vehanchor.rulers.vehicles import Vehicles, VehicleWitness
from vehanchor.scale.countries import (
    COUNTRIES,
    COUNTRY_LENGTHS_M,
    COUNTRY_REGIONS,
    REGIONS,
    country_code,
    country_length,
)
from vehanchor.scale.density import Votes
from vehanchor.scale.posterior import answer

_LENGTHS = [40.0, 41.0, 42.0, 40.0, 41.0, 90.0]


def _view(lengths: list[float], **options: Any) -> View:
    rows = [[99.0 * k, 50, length, 18, 0] for k, length in enumerate(lengths)]
    boxes = np.array(rows).reshape(-1, 5)
    found = Detections(boxes, np.full(len(boxes), 0.8))
    return View(
        ImageFacts(800, 600),
        found,
        card=made_card(5.0),
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )


def _doubts(view: View) -> tuple[list[str], float]:
    witness = Vehicles().measure(view)
    return [notice.code for notice in witness.notices], witness.chance_wrong


def _searched(view: View, **changes: Any) -> View:
    """A view after a search over scales."""
    found = replace(view.detections, reductions=np.ones(len(view.detections.boxes)), **changes)
    return replace(view, detections=found)


def _fleet(n: int, mean_px: float = 40.0) -> list[float]:
    """Lengths that spread as those of cars do."""
    return list(mean_px * np.exp(0.09 * np.linspace(-1.7, 1.7, n)))


EQUAL = [40.0] * 30


def test_a_fleet_is_not_doubted() -> None:
    codes, chance_wrong = _doubts(_searched(_view(_fleet(30))))
    assert codes == []
    assert chance_wrong <= 0.1


def test_equal_things_may_be_look_alikes() -> None:
    assert _doubts(_searched(_view(EQUAL)))[0] == ["look_alikes"]


def test_copies_that_were_left_out_still_show_equal_things() -> None:
    with_copies = _searched(_view(EQUAL)).detections
    assert _doubts(_searched(_view([40.0]), with_copies=with_copies))[0] == ["look_alikes"]


def test_a_stretched_image_is_doubted() -> None:
    assert _doubts(_searched(_view(_fleet(30)), stretch=1.5))[0] == ["stretched"]


@pytest.mark.parametrize(("log_odds", "codes"), [(1.5, ["stretched"]), (0.5, [])])
def test_one_network_needs_odds_for_a_stretch(log_odds: float, codes: list[str]) -> None:
    view = _searched(_view(_fleet(4)), stretch=1.2, stretch_log_odds=log_odds)
    assert _doubts(view)[0] == codes


def test_equal_things_of_one_resolution_are_not_doubted() -> None:
    """They were not chosen by their length."""
    assert _doubts(_view(EQUAL))[0] == []


def test_both_doubts_can_be_about_one_fleet() -> None:
    assert _doubts(_searched(_view(EQUAL), stretch=1.5))[0] == ["stretched", "look_alikes"]


@pytest.fixture(scope="module")
def two_groups() -> VehicleWitness:
    """Twelve vehicles of one length, and six that are two and a half times as long."""
    return Vehicles().measure(_searched(_view([*_fleet(12), *_fleet(6, mean_px=100.0)])))


def test_the_larger_of_two_groups_of_lengths_is_the_fleet(two_groups: VehicleWitness) -> None:
    assert two_groups.n == 12


def test_a_rival_group_raises_the_chance_of_error(two_groups: VehicleWitness) -> None:
    # Half of the weight, squared: odds of one to four.
    assert two_groups.chance_wrong == pytest.approx(1 / 5, abs=0.02)


@pytest.mark.parametrize("lengths", [_LENGTHS, [40.0]])
def test_a_remedy_never_raises_the_chance_of_error(lengths: list[float]) -> None:
    witness = Vehicles().measure(_view(lengths))
    assert all(lack.without.chance_wrong <= witness.chance_wrong for lack in witness.lacks)


@pytest.mark.parametrize("lengths", [_LENGTHS, [40.0]])
def test_vehicles_have_five_weaknesses(lengths: list[float]) -> None:
    witness = Vehicles().measure(_view(lengths))
    assert [lack.reason for lack in witness.lacks] == [
        "too_coarse",
        "not_cars",
        "disagree",
        "too_few",
        "imprecise",
    ]


def test_a_guessed_length_replaces_that_of_given_boxes_alone() -> None:
    """A search that pauses has not ended, and its boxes were found."""
    view = replace(_view(_LENGTHS), options=ScaleOptions.of({"reference_length_m": 7.0}))
    pausing = replace(view, detections=replace(view.detections, n_tiles_total=9))
    given = Vehicles().measure(view).reference
    found = Vehicles().measure(pausing).reference
    assert (given.length_m, given.guess_m) == (7.0, None)
    assert (found.length_m, found.guess_m) == (5.0, 7.0)


@pytest.fixture(scope="module")
def card() -> DetectorCard:
    return load_detector(resolve_model()).card


def _reference_log_sd(card: DetectorCard, scores: list[float], work: float = 0.0) -> float:
    """Error of the reference length of cars that all look 4.4 m long.

    Args:
        card: the bundled detector's.
        scores: of the cars.
        work: chance of a work vehicle, for each.
    """
    view = _searched(replace(_view([40.0] * len(scores)), card=card))
    looks = np.full(len(scores), math.log(4.4))
    appearance = Appearance(
        looks,
        np.full(len(scores), 0.1),
        logits=np.full(len(scores), 5.0),
        work_chances=np.full(len(scores), work),
    )
    found = replace(view.detections, scores=np.array(scores), appearance=appearance)
    return Vehicles().measure(replace(view, detections=found)).reference.log_sd


def test_few_cars_err_more_by_their_appearance_than_many(card: DetectorCard) -> None:
    assert _reference_log_sd(card, [0.99]) > 1.2 * _reference_log_sd(card, [0.99] * 12)


def test_vans_err_more_by_their_appearance_than_cars(card: DetectorCard) -> None:
    cars = _reference_log_sd(card, [0.99] * 2)
    some_vans = _reference_log_sd(card, [0.99] * 2, work=0.3)
    vans = _reference_log_sd(card, [0.99] * 2, work=0.9)
    assert cars < some_vans < vans
    assert vans > 2 * cars


def test_boxes_that_are_hardly_cars_do_not_count_as_cars(card: DetectorCard) -> None:
    one_car = _reference_log_sd(card, [0.99])
    with_doubtful_ones = _reference_log_sd(card, [0.99, 0.2, 0.2, 0.2])
    assert with_doubtful_ones == pytest.approx(one_car, rel=0.03)


@pytest.mark.parametrize("code", ["FR", "fr", "Us", "in", "NP"])
def test_a_country_has_a_length_near_its_region(card: DetectorCard, code: str) -> None:
    chosen = reference_length(card, Reference(region=code), None)
    assert chosen.source == "region"
    assert chosen.length_m == pytest.approx(
        card.region_lengths_m[COUNTRY_REGIONS[code.upper()]], rel=0.02
    )


def test_a_region_without_lengths_of_boxes_has_those_of_bodies(card: DetectorCard) -> None:
    assert card.bodies is not None
    without = card.model_copy(update={"region_lengths_m": {}})
    chosen = reference_length(without, Reference(region="europe"), None)
    assert chosen.length_m == card.bodies.region_lengths_m["europe"]


def test_every_country_has_one_of_the_regions() -> None:
    assert set(COUNTRY_REGIONS.values()) == set(REGIONS)
    assert set(COUNTRY_LENGTHS_M) < set(COUNTRY_REGIONS)


def test_the_code_of_a_country_has_two_letters() -> None:
    assert all(re.fullmatch("[A-Z]{2}", code) for code in COUNTRIES)


def test_no_name_belongs_to_two_countries() -> None:
    names = [name for country in COUNTRIES.values() for name in country.names]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("place", "code"),
    [
        ("jp", "JP"),
        ("Japan", "JP"),
        ("South Korea", "KR"),
        ("Guinea-Bissau", "GW"),
        ("Côte d\N{RIGHT SINGLE QUOTATION MARK}Ivoire", "CI"),
        ("Antigua & Barbuda", "AG"),
        ("The Netherlands", "NL"),
        ("Atlantis", None),
    ],
)
def test_a_country_is_found_by_its_name(place: str, code: str | None) -> None:
    assert country_code(place) == code


@pytest.mark.parametrize("place", ["JP", "korea", "Australia"])
def test_a_country_without_measured_cars_counts_as_unknown(card: DetectorCard, place: str) -> None:
    unknown = reference_length(card, Reference(), None)
    assert reference_length(card, Reference(region=place), None) == unknown


def test_a_country_without_measured_cars_is_named(card: DetectorCard) -> None:
    (notice,) = unmeasured_region(card, Reference(region="JP"))
    assert notice.code == "region_unmeasured"
    assert "cars of JP" in notice.message


@pytest.mark.parametrize("region", ["FR", "Mexico", "europe", None])
def test_a_measured_region_is_not_warned_of(card: DetectorCard, region: str | None) -> None:
    assert unmeasured_region(card, Reference(region=region)) == ()


def test_a_published_length_is_converted_to_the_boxes_of_a_detector() -> None:
    loose = {
        "europe": 1.1 * COUNTRY_LENGTHS_M["FR"],
        "north_america": 1.1 * COUNTRY_LENGTHS_M["US"],
    }
    assert country_length("DE", loose) == pytest.approx(1.1 * COUNTRY_LENGTHS_M["DE"])
    assert country_length("ES", loose) == loose["europe"]
    assert country_length("NP", loose) is None
    assert country_length("DE", {}) is None


@pytest.mark.parametrize(
    ("region", "words"),
    [
        ("Mexico", "Cars in MX are taken to be as long as those measured in south_america."),
        ("ch", "The usual length of cars in CH is from a published mean."),
        ("South America", None),
        ("JP", None),
        (None, None),
    ],
)
def test_the_answer_states_whose_cars_stand_for_those_of_a_country(
    card: DetectorCard, region: str | None, words: str | None
) -> None:
    assert country_in_words(card, Reference(region=region)) == words


def test_a_region_is_found_in_any_case(card: DetectorCard) -> None:
    reference = reference_length(card, Reference(region="Europe"), None)
    assert reference.length_m == card.region_lengths_m["europe"]


@pytest.mark.parametrize(
    ("region", "expected"),
    [
        ("eurpe", "nearest: europe"),
        ("south asai", "nearest: south_asia"),
        ("ZZ", "leave region out"),
    ],
)
def test_an_unknown_place_names_the_nearest(card: DetectorCard, region: str, expected: str) -> None:
    with pytest.raises(InvalidParameterError, match=expected):
        reference_length(card, Reference(region=region), None)


CARS_OF_4_4_M = Appearance(
    math.log(4.4) + 0.07 * np.linspace(-1.7, 1.7, 30), np.full(30, 0.07), logits=np.full(30, 4.0)
)


def test_without_a_region_the_appearance_gives_the_length(card: DetectorCard) -> None:
    reference = reference_length(card, Reference(), CARS_OF_4_4_M)
    assert reference.source == "appearance"
    assert reference.log_sd == card.errors.appearance.log_sd
    assert reference.length_m == pytest.approx(4.4)


def test_a_region_moves_the_length_by_appearance(card: DetectorCard) -> None:
    reference = reference_length(card, Reference(region="NP"), CARS_OF_4_4_M)
    assert reference.source == "region"
    assert card.bodies is not None
    assert card.bodies.region_lengths_m["south_asia"] < reference.length_m < 4.4


def test_a_region_narrows_the_length_by_appearance(card: DetectorCard) -> None:
    without = reference_length(card, Reference(), CARS_OF_4_4_M)
    with_region = reference_length(card, Reference(region="NP"), CARS_OF_4_4_M)
    assert with_region.log_sd < 0.9 * without.log_sd


def test_of_two_cars_the_more_certain_one_counts_more(card: DetectorCard) -> None:
    def gsd(*scores: float) -> float:
        appearance = Appearance(np.log([4.3, 4.7]), np.full(2, 0.07), np.full(2, 4.0))
        view = _view([45.0, 45.0])
        detections = replace(view.detections, scores=np.array(scores), appearance=appearance)
        decided = answer([Vehicles().measure(replace(view, card=card, detections=detections))])
        assert decided is not None
        return decided.gsd_m_per_px

    shorter = gsd(0.99, 0.9)
    longer = gsd(0.9, 0.99)
    assert 1.02 * shorter < longer < 1.08 * shorter


# --- The detector's own numbers


def _with_errors(view: View, group: str, **numbers: Any) -> View:
    """A view whose detector has other errors."""
    errors = view.card.errors
    changed = getattr(errors, group).model_copy(update=numbers)
    update = {"errors": errors.model_copy(update={group: changed})}
    return replace(view, card=view.card.model_copy(update=update))


def test_a_wider_spread_of_boxes_widens_the_interval() -> None:
    view = _view(_LENGTHS)
    narrow = Vehicles().measure(_with_errors(view, "boxes", log_sd=0.1))
    wide = Vehicles().measure(_with_errors(view, "boxes", log_sd=0.3))
    assert log_sd(wide) > 1.1 * log_sd(narrow)


def test_the_chance_of_wrong_vehicles_is_the_detectors() -> None:
    view = _view(_fleet(30))
    calibrated = view.card.model_copy(update={"votes": Votes(-13.0, 17.0)})
    often_wrong = _with_errors(replace(view, card=calibrated), "vehicles", chance_wrong=0.2)
    assert Vehicles().measure(often_wrong).chance_wrong == pytest.approx(0.2)


def test_the_errors_of_coarse_vehicles_are_the_detectors() -> None:
    view = _view(_fleet(30, mean_px=6.0))
    exact = _with_errors(view, "vehicles", coarse_log_sd=0.0, coarse_chance_wrong=0.0)
    assert Vehicles().measure(view).coarseness > 1.0
    assert log_sd(Vehicles().measure(view)) > log_sd(Vehicles().measure(exact))
    assert Vehicles().measure(view).chance_wrong > Vehicles().measure(exact).chance_wrong


def test_the_odds_of_look_alikes_are_the_detectors() -> None:
    view = _searched(_view(EQUAL))
    assert _doubts(view)[0] == ["look_alikes"]
    assert _doubts(_with_errors(view, "look_alikes", spread_power=0.0))[0] == []


def test_the_mean_logit_of_cars_is_the_detectors() -> None:
    view = _searched(_view(_fleet(30)), appearance=CARS_OF_4_4_M)
    assert _doubts(view)[0] == []
    assert _doubts(_with_errors(view, "look_alikes", mean_logit=7.0))[0] == ["look_alikes"]


@pytest.mark.parametrize("region", [None, "NP"])
def test_the_errors_of_the_appearance_are_the_detectors(
    card: DetectorCard, region: str | None
) -> None:
    appearance = card.errors.appearance.model_copy(update={"log_sd": 0.11, "log_mean": 0.0})
    errors = card.errors.model_copy(update={"appearance": appearance})
    other = card.model_copy(update={"errors": errors})
    before = reference_length(card, Reference(region=region), CARS_OF_4_4_M)
    after = reference_length(other, Reference(region=region), CARS_OF_4_4_M)
    assert after.log_sd > 1.2 * before.log_sd
    assert after.log_mean == 0.0


def _fleet_of(card: DetectorCard, lengths_m: list[float]) -> View:
    """A view of vehicles of one length in pixels, and of these lengths by appearance."""
    n = len(lengths_m)
    view = replace(_view([40.0] * n), card=card)
    appearance = Appearance(np.log(lengths_m), np.full(n, 0.07), np.full(n, 4.0))
    return replace(view, detections=replace(view.detections, appearance=appearance))


def test_vehicles_that_scatter_widen_the_interval(card: DetectorCard) -> None:
    scattered = _fleet_of(card, [3.5, 3.6, 4.0, 4.4, 4.9, 5.4, 5.5])
    usual = _with_errors(scattered, "appearance", scatter_cars=1000.0)
    assert log_sd(Vehicles().measure(scattered)) > 1.05 * log_sd(Vehicles().measure(usual))


def test_vehicles_that_agree_do_not_narrow_the_interval(card: DetectorCard) -> None:
    alike = _fleet_of(card, [4.4] * 7)
    usual = _with_errors(alike, "appearance", scatter_cars=1000.0)
    assert log_sd(Vehicles().measure(alike)) == log_sd(Vehicles().measure(usual))


@pytest.mark.parametrize(
    "numbers", [{"fair_odds": 2000.0, "doubt_power": 0.5}, {"doubt_power": 1.0}]
)
def test_the_doubt_of_an_appearance_is_the_detectors(
    card: DetectorCard, numbers: dict[str, float]
) -> None:
    view = replace(_view(_fleet(30)), card=card)
    view = replace(view, detections=replace(view.detections, appearance=CARS_OF_4_4_M))
    before = log_sd(Vehicles().measure(view))
    after = log_sd(Vehicles().measure(_with_errors(view, "appearance", **numbers)))
    assert after > before
