"""Words about listed vehicles."""

from __future__ import annotations

from vehanchor_server.calls.listed_vehicle import ListedVehicle, vehicles_in_words

VEHICLE = ListedVehicle(number=1, x_px=20.0, y_px=30.0, length_px=25.0, used=True)


def test_a_list_that_leaves_out_vehicles_says_how_many_there_are() -> None:
    words = vehicles_in_words([VEHICLE], 158)
    assert words.startswith("The 1 surest of 158 vehicles by their numbers in drop")


def test_a_whole_list_begins_with_its_vehicles() -> None:
    assert vehicles_in_words([VEHICLE], 1).startswith("Vehicles by their numbers in drop")
