from __future__ import annotations

import re

import numpy as np
import pytest

from vehanchor.detection.appearance import FleetAppearance
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detector import load_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Reference
from vehanchor.rulers.reference import reference_length
from vehanchor.scale.countries import COUNTRY_LENGTHS_M, COUNTRY_REGIONS, country_length
from vehanchor.scale.defaults import REGIONS
from vehanchor.scale.density import blurred, credible_interval
from vehanchor.scale.reliability import FLEETS
from vehanchor.scale.votes import vehicle_likelihood


@pytest.fixture(scope="module")
def card() -> DetectorCard:
    return load_detector(resolve_model()).card


@pytest.mark.parametrize("code", ["FR", "fr", "Us", "in", "NP"])
def test_a_country_has_a_length_near_its_region(card: DetectorCard, code: str) -> None:
    chosen = reference_length(card, Reference(region=code), None)
    assert chosen.source == "region"
    assert chosen.length_m == pytest.approx(card.region_lengths_m[COUNTRY_REGIONS[code.upper()]], rel=0.02)


def test_every_country_has_one_of_the_regions_and_a_code_of_two_letters() -> None:
    assert set(COUNTRY_REGIONS.values()) == set(REGIONS)
    assert set(COUNTRY_LENGTHS_M) < set(COUNTRY_REGIONS)
    assert all(re.fullmatch("[A-Z]{2}", code) for code in COUNTRY_REGIONS)


def test_a_published_length_is_converted_to_the_boxes_of_a_detector() -> None:
    loose = {"europe": 1.1 * COUNTRY_LENGTHS_M["FR"], "north_america": 1.1 * COUNTRY_LENGTHS_M["US"]}
    assert country_length("DE", loose) == pytest.approx(1.1 * COUNTRY_LENGTHS_M["DE"])
    assert country_length("ES", loose) == loose["europe"]
    assert country_length("NP", loose) is None
    assert country_length("DE", {}) is None


@pytest.mark.parametrize(
    ("region", "expected"),
    [("Europe", None), ("eurpe", "nearest: europe"), ("south asia", "nearest: south_asia"), ("JP", "or give")],
)
def test_an_unknown_place_names_the_nearest(card: DetectorCard, region: str, expected: str | None) -> None:
    if expected is None:
        assert reference_length(card, Reference(region=region), None).length_m == card.region_lengths_m["europe"]
        return
    with pytest.raises(InvalidParameterError, match=expected):
        reference_length(card, Reference(region=region), None)


def test_an_unknown_fleet_may_have_smaller_cars_than_it_seems(card: DetectorCard) -> None:
    seen = FleetAppearance(np.zeros(30), np.full(30, 1.53))
    read = reference_length(card, Reference(), seen)
    assert card.votes is not None
    assert (read.source, read.errors) == ("appearance", FLEETS)
    lengths = 46.0 * np.exp(0.09 * np.linspace(-1.7, 1.7, 40))
    votes = vehicle_likelihood(lengths, np.full(40, 0.95), read.length_m, card.votes)
    low, high = credible_interval(blurred(votes, *read.errors))
    assert low * 46.0 == pytest.approx(3.7, rel=0.01)  # Nepal's fleet, read as one of 4.5 m
    assert read.length_m < high * 46.0
    named = reference_length(card, Reference(region="NP"), seen)
    assert [mean for _, mean, _ in named.errors] == [0.0]
