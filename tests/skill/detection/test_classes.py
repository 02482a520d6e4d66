from __future__ import annotations

from typing import Any

import pytest

from vehanchor.detection.classes import vehicle_classes
from vehanchor.errors import InvalidParameterError, ModelContractError


@pytest.mark.parametrize(
    ("names", "n_classes", "wanted", "found"),
    [
        ({0: "plane", 1: "small-vehicle", 2: "car"}, 3, None, [1]),
        ({0: "bus", 1: "Car"}, 2, None, [1]),
        ({0: "roof", 1: "VEHICLE"}, None, None, [1]),
        ({3: "thing"}, None, None, [3]),
        ({}, 1, None, [0]),
        ({}, 15, None, [10]),  # DOTA's order
        ({}, 15, ["large_vehicle", "ship"], [1, 9]),
        ({0: "a", 1: "b", 2: "b"}, 3, ["b", 0], [0, 1, 2]),
        ({}, 3, [2, 0, 2], [0, 2]),
        ({}, None, [7], [7]),
    ],
)
def test_vehicles_are_told_by_name_or_as_asked(
    names: Any, n_classes: int | None, wanted: Any, found: list[int]
) -> None:
    assert vehicle_classes(names, n_classes, wanted).tolist() == found


@pytest.mark.parametrize(
    ("names", "n_classes", "wanted"),
    [
        ({0: "car"}, 1, ["bus"]),
        ({0: "car"}, 1, [1]),
        ({}, 3, [3]),
        ({}, 3, [-1]),
        ({}, None, ["car"]),
        ({0: "car"}, 1, []),
    ],
)
def test_classes_that_the_model_lacks_are_refused(names: Any, n_classes: int | None, wanted: Any) -> None:
    with pytest.raises(InvalidParameterError, match="class"):
        vehicle_classes(names, n_classes, wanted)


def test_a_model_without_vehicles_says_what_it_has() -> None:
    with pytest.raises(ModelContractError, match=r"ship, harbor.*classes="):
        vehicle_classes({0: "ship", 1: "harbor"}, 2)
    with pytest.raises(ModelContractError, match="no names"):
        vehicle_classes({}, 2)
