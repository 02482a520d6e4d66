from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.analyses import made_card
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.detector import load_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Reference, ScaleOptions
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.ruler import View
from vehanchor.rulers.vehicles import Vehicles, VehicleWitness
from vehanchor.scale.countries import COUNTRY_LENGTHS_M, COUNTRY_REGIONS, REGIONS, country_length
from vehanchor.scale.posterior import answer
from vehanchor.scale.reliability import APPEARANCE_LOG_SD

_LENGTHS = [40.0, 41.0, 42.0, 40.0, 41.0, 90.0]


def _view(lengths: list[float], **options: Any) -> View:
    boxes = np.array([[99.0 * k, 50, length, 18, 0] for k, length in enumerate(lengths)]).reshape(
        -1, 5
    )
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


def test_equal_things_are_probably_no_cars() -> None:
    equal = _view([40.0] * 30)
    fleet = _view(list(40 * np.exp(0.09 * np.linspace(-1.7, 1.7, 30))))
    codes, chance_wrong = _doubts(_searched(fleet))
    assert codes == []
    assert chance_wrong <= 0.1
    assert _doubts(_searched(equal))[0] == ["look_alikes"]
    assert _doubts(_searched(fleet, stretch=1.5))[0] == ["stretched"]
    assert _doubts(equal)[0] == []  # found at one scale: they were not chosen by their length


def test_both_doubts_can_be_about_one_fleet() -> None:
    assert _doubts(_searched(_view([40.0] * 30), stretch=1.5))[0] == ["stretched", "look_alikes"]


def test_of_two_groups_of_lengths_one_is_the_fleet() -> None:
    lengths = [
        *(40 * np.exp(0.09 * np.linspace(-1.7, 1.7, 12))),
        *(100 * np.exp(0.09 * np.linspace(-1.7, 1.7, 6))),
    ]
    witness = Vehicles().measure(_searched(_view(lengths)))
    assert witness.n == 12
    # odds of one to four: half of the weight, squared
    assert witness.chance_wrong == pytest.approx(1 / 5, abs=0.02)


@pytest.mark.parametrize("lengths", [_LENGTHS, [40.0]])
def test_a_lack_filled_is_never_worse_than_the_vehicles_as_they_are(lengths: list[float]) -> None:
    witness: VehicleWitness = Vehicles().measure(_view(lengths))
    assert [lack.reason for lack in witness.lacks] == [
        "too_coarse",
        "not_cars",
        "disagree",
        "too_few",
        "imprecise",
    ]
    assert all(lack.without.chance_wrong <= witness.chance_wrong for lack in witness.lacks)


@pytest.fixture(scope="module")
def card() -> DetectorCard:
    return load_detector(resolve_model()).card


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


def test_every_country_has_one_of_the_regions_and_a_code_of_two_letters() -> None:
    assert set(COUNTRY_REGIONS.values()) == set(REGIONS)
    assert set(COUNTRY_LENGTHS_M) < set(COUNTRY_REGIONS)
    assert all(re.fullmatch("[A-Z]{2}", code) for code in COUNTRY_REGIONS)


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
    ("region", "expected"),
    [
        ("Europe", None),
        ("eurpe", "nearest: europe"),
        ("south asai", "nearest: south_asia"),
        ("TV", "leave region out"),
    ],
)
def test_an_unknown_place_names_the_nearest(
    card: DetectorCard, region: str, expected: str | None
) -> None:
    if expected is None:
        assert (
            reference_length(card, Reference(region=region), None).length_m
            == card.region_lengths_m["europe"]
        )
        return
    with pytest.raises(InvalidParameterError, match=expected):
        reference_length(card, Reference(region=region), None)


def test_a_named_region_narrows_a_fleet_that_is_read_by_its_looks(card: DetectorCard) -> None:
    seen = Appearance(np.full(30, math.log(4.4)), np.full(30, 0.07), np.full(30, 4.0))
    read, named = (
        reference_length(card, Reference(region=region), seen) for region in (None, "NP")
    )
    assert (read.source, read.log_sd, named.source) == ("appearance", APPEARANCE_LOG_SD, "region")
    assert read.length_m == pytest.approx(4.4)
    assert card.bodies is not None
    assert card.bodies.region_lengths_m["south_asia"] < named.length_m < 4.4
    assert named.log_sd < 0.9 * read.log_sd


def test_of_two_cars_the_surer_one_tells_more(card: DetectorCard) -> None:
    seen = Appearance(np.log([4.3, 4.7]), np.full(2, 0.07), np.full(2, 4.0))
    view = replace(_view([45.0, 45.0]), card=card)
    answers = [
        answer(
            [
                Vehicles().measure(
                    replace(
                        view, detections=replace(view.detections, scores=scores, appearance=seen)
                    )
                )
            ]
        )
        for scores in (np.array([0.99, 0.9]), np.array([0.9, 0.99]))
    ]
    shorter, longer = (each.gsd_m_per_px for each in answers if each)
    assert 1.02 * shorter < longer < 1.08 * shorter
