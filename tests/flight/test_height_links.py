"""The camera's height links a photograph whose picture matches no other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import made_card
from tests.flight.ground import facts_at, features_of, ground, photograph_of, vehicles_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import ScaleOptions
from vehanchor_flight.features import Features
from vehanchor_flight.linking import link_photographs
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import conclude_flight
from vehanchor_flight.records import FlightEstimate

GSD_M_PER_PX = 0.1
FLEET = 50.0 * (1 + 0.05 * np.linspace(-1, 1, 12) ** 3)
NO_CARS = np.zeros(0)
WORLD = ground(seed=5)
SIDE_PX = 500
FOCAL_35MM = 24.0
# Height at which a photograph of 500 x 500 px has 0.1 m/px with this lens.
HEIGHT_M = GSD_M_PER_PX * FOCAL_35MM * np.hypot(SIDE_PX, SIDE_PX) / np.hypot(36, 24)


def _taken(
    east_m: float, height_m: float, time: str = "2025:10:05 16:40:31", model: str = "X"
) -> ImageFacts:
    facts = facts_at(east_m, 0.0, SIDE_PX)
    assert facts.camera is not None
    camera = replace(
        facts.camera,
        make="Maker",
        model=model,
        height_m=float(height_m),
        height_tag="DJI RelativeAltitude",
        focal_35mm=FOCAL_35MM,
        off_nadir_deg=0.0,
        taken_at=time,
    )
    return facts._replace(camera=camera)


def _photograph(name: str, image: ImageFacts, lengths: NDArray[np.float64]) -> Photograph:
    stored = StoredPhotograph(image, vehicles_of(lengths), 1.0)
    options = ScaleOptions.of({"rulers": ("vehicles", "positions")})
    return Photograph.of(name, stored, made_card(5.0), options)


NO_FEATURES = features_of(np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8))


def _conclude(photographs: list[Photograph], features: list[Features]) -> FlightEstimate:
    components, links = link_photographs(photographs, features)
    return conclude_flight(photographs, components, made_card(5.0), same_scale=False, links=links)


def _flight(image: ImageFacts, lengths: NDArray[np.float64] = NO_CARS) -> FlightEstimate:
    """Conclude a flight of two photographs that match, and a third one that does not."""
    features: list[Features] = []
    photographs = []
    for number in range(2):
        features.append(features_of(photograph_of(WORLD, 600 + 150 * number, 600)))
        facts = _taken(15.0 * number, HEIGHT_M)
        photographs.append(_photograph(str(number), facts, FLEET if number == 0 else NO_CARS))
    photographs.append(_photograph("unmatched", image, lengths))
    features.append(NO_FEATURES)
    return _conclude(photographs, features)


@pytest.mark.parametrize("height_share", [1.0, 1.3])
def test_a_neighbour_of_known_height_has_the_scale_of_the_flight(height_share: float) -> None:
    flight = _flight(_taken(30.0, HEIGHT_M * height_share))
    photograph = flight.photographs[2]
    assert photograph.status == "ok"
    assert photograph.gsd_m_per_px == pytest.approx(GSD_M_PER_PX * height_share, rel=0.03)
    (link,) = (link for link in flight.links if link.second == "unmatched")
    assert link.n_matches == 0


def test_a_chain_of_neighbours_has_one_scale() -> None:
    photographs = [_photograph("with cars", _taken(0.0, HEIGHT_M), FLEET)]
    for number in (3, 1, 2):
        facts = _taken(15.0 * number, HEIGHT_M)
        photographs.append(_photograph(str(number), facts, NO_CARS))
    flight = _conclude(photographs, [NO_FEATURES] * 4)
    assert [photograph.status for photograph in flight.photographs] == ["ok"] * 4


def test_photographs_that_match_each_other_have_the_scale_of_a_neighbour() -> None:
    photographs = [_photograph("with cars", _taken(0.0, HEIGHT_M), FLEET)]
    features = [NO_FEATURES]
    for number in (1, 2):
        photographs.append(_photograph(str(number), _taken(15.0 * number, HEIGHT_M), NO_CARS))
        features.append(features_of(photograph_of(WORLD, 600 + 150 * number, 600)))
    flight = _conclude(photographs, features)
    assert [photograph.status for photograph in flight.photographs] == ["ok"] * 3


def test_cars_of_a_photograph_of_unknown_overlap_are_not_added() -> None:
    flight = _flight(_taken(30.0, HEIGHT_M), FLEET[:3])
    assert flight.components[0].n_photographs == 3
    assert flight.n_vehicles == 12


UNRELATED = {
    "far away": _taken(80.0, HEIGHT_M),
    "another sortie": _taken(30.0, HEIGHT_M, time="2025:10:05 18:40:31"),
    "another camera": _taken(30.0, HEIGHT_M, model="Y"),
    "no height": facts_at(30.0, 0.0),
}


@pytest.mark.parametrize("image", UNRELATED.values(), ids=UNRELATED)
def test_a_photograph_of_other_ground_or_camera_is_not_linked(image: ImageFacts) -> None:
    assert _flight(image).photographs[2].status == "no_scale"


def test_a_usable_photograph_keeps_its_own_scale() -> None:
    flight = _flight(_taken(30.0, HEIGHT_M), FLEET)
    assert len(flight.components) == 2
