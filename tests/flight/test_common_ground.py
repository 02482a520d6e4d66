"""Cars that several photographs show count once."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.flight.ground import ground
from tests.models import blank_image, car_park, paint_vehicles, write_detector
from vehanchor.detection.detector import Detector
from vehanchor.rulers.ruler import point_witness
from vehanchor.scale.density import credible_interval
from vehanchor_flight.common_ground import Placement, n_distinct
from vehanchor_flight.pooling import _pooled_witness
from vehanchor_flight.records import FlightEstimate
from vehanchor_flight.verbs import estimate_flight

Picture = NDArray[np.uint8]
Place = tuple[float, float]

WORLDS = [ground(900, seed=seed) for seed in range(5)]
WIDTH_PX = 480
HEIGHT_PX = 360
# Two cars, in pixels of the world.
PARKED: list[Place] = [(420, 400), (520, 460)]
LENGTHS = (30.0, 31.0)
MODES = pytest.mark.parametrize("same_scale", [False, True], ids=["linked", "same scale"])


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector(write_detector(tmp_path_factory.mktemp("model") / "painted.onnx"))


def _frame(
    world: Picture, left: int, top: int, cars: Sequence[Place], lengths: Sequence[float] = LENGTHS
) -> Picture:
    """Cut a picture out of a world, with cars at these places of the world."""
    picture = world[top : top + HEIGHT_PX, left : left + WIDTH_PX].copy()
    boxes = []
    for (x, y), length in zip(cars, lengths, strict=True):
        boxes.append([x - left, y - top, length, 12, 0.4])
    paint_vehicles(picture, boxes)
    return picture


def _flight(pictures: Sequence[Picture], detector: Detector, same_scale: bool) -> FlightEstimate:
    return estimate_flight(
        list(pictures), same_scale=same_scale, detector=detector, rulers=("vehicles",)
    )


def _surest_alone(flight: FlightEstimate) -> float:
    return max(photograph.own.confidence for photograph in flight.photographs if photograph.own)


@MODES
def test_copies_of_a_photograph_are_as_sure_as_one(detector: Detector, same_scale: bool) -> None:
    picture = _frame(WORLDS[0], 200, 200, PARKED)
    brighter = cv2.convertScaleAbs(picture, alpha=1.0, beta=2.0).astype(np.uint8)
    paint_vehicles(brighter, [[220, 200, 30, 12, 0.4], [320, 260, 31, 12, 0.4]])
    flight = _flight([picture, picture.copy(), brighter, picture.copy()], detector, same_scale)
    assert flight.n_vehicles == 2
    assert flight.confidence == pytest.approx(_surest_alone(flight), abs=0.01)


@MODES
def test_a_hovering_film_is_as_sure_as_a_frame(detector: Detector, same_scale: bool) -> None:
    frames = [_frame(WORLDS[0], 200 + 5 * k, 210 - 3 * k, PARKED) for k in range(8)]
    flight = _flight(frames, detector, same_scale)
    assert flight.n_vehicles == 2
    assert flight.confidence == pytest.approx(_surest_alone(flight), abs=0.02)


@MODES
def test_cars_that_drive_count_once(detector: Detector, same_scale: bool) -> None:
    frames = []
    for k in range(6):
        driven = [(x + 45.0 * k, y) for x, y in [(250.0, 300.0), (260.0, 500.0)]]
        frames.append(_frame(WORLDS[0], 200, 200, driven))
    flight = _flight(frames, detector, same_scale)
    assert flight.n_vehicles == 2
    assert flight.confidence == pytest.approx(_surest_alone(flight), abs=0.02)


def test_cars_on_new_ground_are_counted(detector: Detector) -> None:
    cars = [*PARKED, (720.0, 420.0)]
    first = _frame(WORLDS[0], 200, 200, cars[:2])
    second = _frame(WORLDS[0], 400, 200, cars, (*LENGTHS, 29.5))
    flight = _flight([first, second], detector, same_scale=False)
    assert len(flight.components) == 1
    assert flight.n_vehicles == 3


@MODES
def test_different_photographs_are_surer_than_one(detector: Detector, same_scale: bool) -> None:
    pictures = []
    for k, world in enumerate(WORLDS):
        pictures.append(_frame(world, 200, 200, PARKED, (29.0 + 0.5 * k, 31.0 - 0.3 * k)))
    flight = _flight(pictures, detector, same_scale)
    assert len(flight.components) == (1 if same_scale else 5)
    assert flight.n_vehicles == 10
    if same_scale:
        assert flight.confidence > _surest_alone(flight) + 0.1


@MODES
def test_copies_without_features_count_once(detector: Detector, same_scale: bool) -> None:
    picture = car_park(LENGTHS)
    flight = _flight([picture, picture.copy(), picture.copy()], detector, same_scale)
    assert flight.n_vehicles == 2


@MODES
def test_a_film_over_plain_ground_counts_its_cars_once(
    detector: Detector, same_scale: bool
) -> None:
    frames = []
    for k in range(6):
        frame = blank_image(WIDTH_PX, HEIGHT_PX)
        paint_vehicles(frame, [[150 + 6 * k, 120, 30, 12, 0.4], [260 + 6 * k, 200, 31, 12, 1.2]])
        frames.append(frame)
    flight = _flight(frames, detector, same_scale)
    assert flight.n_vehicles == 2


def test_plain_pictures_of_other_cars_are_surer_than_one(detector: Detector) -> None:
    pictures = [car_park([29.0 + 0.6 * k, 31.0 - 0.4 * k]) for k in range(5)]
    flight = _flight(pictures, detector, same_scale=True)
    assert flight.n_vehicles == 10
    assert flight.confidence > _surest_alone(flight) + 0.1


def _placement(left: float, ground_number: int = 0) -> Placement:
    corners = np.array([0, 100, 100 + 100j, 100j])
    return Placement(ground_number, 1.0 + 0j, shift=complex(left), corners=corners)


@pytest.mark.parametrize(
    ("placements", "n"),
    [
        ([_placement(0), _placement(0), _placement(0)], 1.0),
        ([_placement(0), _placement(50)], 1.5),
        ([_placement(0), _placement(200)], 2.0),
        ([_placement(0), _placement(0, 1)], 2.0),
    ],
)
def test_ground_is_counted_once(placements: list[Placement], n: float) -> None:
    assert n_distinct(placements) == pytest.approx(n)


def test_a_court_in_copies_of_a_photograph_is_measured_once() -> None:
    court = point_witness("courts", 0.1, log_sd=0.1, chance_wrong=0.08, statement="{}")
    assert court.right is not None
    pooled = _pooled_witness("courts", [(court, 0.0)] * 5, 1.0)
    assert pooled.right is not None
    assert pooled.n == 1
    assert credible_interval(pooled.right) == pytest.approx(credible_interval(court.right))
