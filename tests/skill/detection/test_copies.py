"""Vehicles whose pixels repeat those of another one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehanchor.detection.copies import without_copies
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.imagery.sources.arrays import ArrayRaster

LENGTH_PX = 40


def _car(seed: int) -> NDArray[np.uint8]:
    """Blotches of a car's size, 60 x 60 px."""
    rng = np.random.default_rng(seed)
    blotches = cv2.GaussianBlur(rng.normal(0, 160, (60, 60, 3)), (0, 0), 2.0)
    return np.clip(130 + 4 * blotches, 0, 255).astype(np.uint8)


def _n_distinct(
    cars: list[NDArray[np.uint8]], quality: int = 85, longer: tuple[float, ...] = ()
) -> int:
    """Count the distinct ones of cars in a row."""
    return len(_distinct(cars, quality, longer).boxes)


def _distinct(
    cars: list[NDArray[np.uint8]], quality: int = 85, longer: tuple[float, ...] = ()
) -> Detections:
    """Paste cars into a row, compress it, and leave out copies.

    ``longer`` are shares by which the first boxes are too long.
    """
    image = np.full((120, 90 * len(cars) + 40, 3), 128, np.uint8)
    boxes = []
    for k, car in enumerate(cars):
        left = 30 + 90 * k
        image[30:90, left : left + 60] = car
        boxes.append([left + 29.5, 59.5, LENGTH_PX, 18.0, 0.0])
    for box, share in zip(boxes, longer, strict=False):
        box[2] *= 1 + share
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    pixels = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
    n = len(cars)
    appearance = Appearance(np.full(n, 1.5), np.full(n, 0.1), np.full(n, 5.0))
    detections = Detections(np.array(boxes), np.full(n, 0.9), appearance=appearance)
    found = without_copies(ArrayRaster(pixels, "array", None), detections)
    assert found.appearance is not None
    assert len(found.boxes) + found.n_copies == n
    assert len(found.appearance) == len(found.boxes)
    return found


def test_one_car_pasted_nine_times_is_one_car() -> None:
    assert _n_distinct([_car(1)] * 9) == 1


def test_a_mirrored_or_turned_copy_is_a_copy() -> None:
    car = _car(1)
    turned = np.ascontiguousarray(car[::-1, ::-1])
    mirrored = np.ascontiguousarray(car[:, ::-1])
    assert _n_distinct([car, turned, mirrored]) == 1


def test_boxes_of_copies_may_differ_in_length() -> None:
    car = _car(1)
    turned = np.ascontiguousarray(np.rot90(car, 2))
    assert _n_distinct([car, turned, car], longer=(0.0, 0.08, -0.08)) == 1


def test_other_cars_are_other_cars() -> None:
    assert _n_distinct([_car(1), _car(2), _car(3)]) == 3


def test_one_car_in_two_photographs_is_no_copy() -> None:
    rng = np.random.default_rng(5)
    again = np.clip(_car(1) + rng.normal(0, 30, (60, 60, 3)), 0, 255).astype(np.uint8)
    assert _n_distinct([_car(1), again]) == 2


def _altered(car: NDArray[np.uint8], gain: float, offset: float, turn: float) -> NDArray[np.uint8]:
    matrix = cv2.getRotationMatrix2D((29.5, 29.5), turn, 1.0)
    turned = cv2.warpAffine(car, matrix, (60, 60), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(turned * gain + offset, 0, 255), np.uint8)


def test_copies_of_other_brightness_contrast_and_direction_are_copies() -> None:
    car = _car(1)
    copies = [_altered(car, 1 - 0.06 * k, 3.0 * k, 1.5 * k) for k in range(5)]
    assert _n_distinct(copies) == 1


def test_the_doubt_about_equal_things_sees_similar_copies() -> None:
    found = _distinct([_altered(_car(1), 1 - 0.06 * k, 3.0 * k, 1.5 * k) for k in range(5)])
    assert found.with_copies is not None
    assert len(found.with_copies.boxes) == 5


def test_copies_are_copies_though_their_boxes_differ_by_a_fourth() -> None:
    copies = [_altered(_car(1), 1 - 0.06 * k, 3.0 * k, 1.5 * k) for k in range(5)]
    assert _n_distinct(copies, longer=(0.0, 0.25, -0.2, 0.2, -0.15)) == 1


def test_other_cars_beside_copies_are_other_cars() -> None:
    copies = [_altered(_car(1), 1 - 0.06 * k, 3.0 * k, 1.5 * k) for k in range(5)]
    assert _n_distinct([*copies, _car(2), _car(3)]) == 3


def test_two_cars_of_one_model_among_others_are_two_cars() -> None:
    twin = _altered(_car(1), 0.8, 20.0, 2.0)
    assert _n_distinct([_car(1), twin, *(_car(seed) for seed in range(2, 7))]) == 7
