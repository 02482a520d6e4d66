from __future__ import annotations

from dataclasses import astuple
from typing import Any

import pytest

from vehanchor.errors import InvalidParameterError
from vehanchor.options import ByHand, ScaleOptions
from vehanchor.options.rulers import MOST_BY_HAND, AddedVehicle, vehicle_numbers


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"drop": "a"}, "drop is 'a': use numbers and ranges with commas"),
        ({"drop": [0]}, "drop is 0: use a whole number from 1"),
        ({"drop": [1.5]}, "drop is 1.5: use a whole number"),
        ({"add": [(1, 2, 3)]}, "add.0.y2 is .*missing"),
        ({"add": [(1, 2, 3, float("nan"))]}, "add.0.y2 is nan"),
        ({"add": 7}, "add is 7: give a list"),
        ({"drop": range(1, MOST_BY_HAND + 2)}, "give at most 1000"),
    ],
)
def test_wrong_vehicles_are_refused_with_what_to_give(told: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of(told)


def test_numbers_are_read_as_lists_and_ranges() -> None:
    assert ByHand(drop=vehicle_numbers("1-3, 7,7")).drop == (1, 2, 3, 7)
    for wrong in ("a", "3-", "-3", "5-2", "1-99999", "1.5"):
        with pytest.raises(InvalidParameterError, match="drop"):
            vehicle_numbers(wrong)


def test_an_axis_is_read_from_four_numbers() -> None:
    assert ScaleOptions.of({"add": ["1, 2, 30 2.5"]}).by_hand.add == (AddedVehicle(1.0, 2.0, 30.0, 2.5),)
    for wrong in ("1 2 3", "1 2 3 4 5", "a b c d"):
        with pytest.raises(InvalidParameterError, match=r"add\.0"):
            ScaleOptions.of({"add": [wrong]})


@pytest.mark.parametrize(
    ("axis", "message"),
    [((0, 0, 4, 0), "add 1 is 4.0 px long"), ((90, 0, 101, 0), r"leaves the picture of 100 x 80 px")],
)
def test_an_added_vehicle_is_inside_and_long_enough(axis: tuple[float, ...], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of({"add": [axis]}).in_pixels(100, 80)


def test_an_added_vehicle_has_the_callers_coordinates() -> None:
    told = ScaleOptions.of({"add": [(0.1, 0.5, 0.3, 0.5)], "coordinates": "fraction"}).in_pixels(1000, 400)
    assert astuple(told.by_hand.add[0]) == pytest.approx((100, 200, 300, 200))
    assert told.frame.coordinates == "pixels"
