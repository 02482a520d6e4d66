"""Scenes of things that are not cars."""

from __future__ import annotations

from research.scenes.further_things import FURTHER_THINGS
from research.scenes.look_alikes import ALL_THINGS, render_cars
from research.scenes.small_vehicles import SMALL_VEHICLES
from research.scenes.things import THINGS


def test_no_kind_of_thing_hides_another_of_its_name() -> None:
    assert len(ALL_THINGS) == len(THINGS) + len(FURTHER_THINGS) + len(SMALL_VEHICLES)


def test_cars_stand_in_the_places_of_things() -> None:
    scene = render_cars(3)
    assert scene.vehicles
    assert {vehicle.kind for vehicle in scene.vehicles} == {"small-vehicle"}
