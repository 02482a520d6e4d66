from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card
from tests.flight.ground import facts_at, sighting_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import ScaleOptions
from vehanchor_flight.components import single_component
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import conclude_flight
from vehanchor_flight.records import FlightEstimate
from vehanchor_flight.sorties import number_sorties

FLEET = 30.0 * (1 + 0.05 * np.linspace(-1, 1, 9) ** 3)


def _taken(time: str, model: str = "FC3170") -> ImageFacts:
    facts = facts_at(0.0, 0.0)
    assert facts.camera is not None
    return facts._replace(camera=replace(facts.camera, model=model, taken_at=time))


@pytest.mark.parametrize(
    ("facts", "numbers"),
    [
        ([_taken("2025:10:05 16:40:31"), _taken("2025:10:05 16:59:31"), _taken("2025:10:05 17:10:00")], [0, 0, 0]),
        ([_taken("2025:10:05 16:40:31"), _taken("2025:10:05 17:40:31"), _taken("2025:10:05 16:41:00")], [0, 1, 0]),
        ([_taken("2025:10:05 16:40:31"), _taken("2025:10:05 16:40:31", "FC220")], [0, 1]),
        ([_taken(""), _taken("2025:10:05 16:40:31"), _taken("yesterday")], [0, 0, 0]),
        ([ImageFacts(9, 9), ImageFacts(9, 9)], [0, 0]),
    ],
)
def test_a_pause_or_another_camera_begins_a_sortie(facts: list[ImageFacts], numbers: list[int]) -> None:
    assert number_sorties(facts) == numbers


def _same_scale(*facts: ImageFacts) -> FlightEstimate:
    card = made_card(5.0)
    photographs = [
        Photograph.of(str(number), StoredPhotograph(each, sighting_of(FLEET), 1.0), card, ScaleOptions())
        for number, each in enumerate(facts)
    ]
    return conclude_flight(photographs, [single_component(range(len(facts)), 0)], card, same_scale=True)


def test_one_scale_for_two_sorties_is_warned_of() -> None:
    two = _same_scale(_taken("2025:10:05 16:40:31"), _taken("2025:10:05 18:40:31"))
    assert [each.sortie for each in two.photographs] == [0, 1]
    (warning,) = (each for each in two.warnings if each.code == "several_sorties")
    assert "2 sorties of 1 and 1 photographs" in warning.message
    one = _same_scale(_taken("2025:10:05 16:40:31"), _taken("2025:10:05 16:40:33"))
    assert "several_sorties" not in {each.code for each in one.warnings}
