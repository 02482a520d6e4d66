"""Shade hides cars without taking them away."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.detector.shade import darken_cars, shaded

pytestmark = pytest.mark.slow
GREY = np.full((96, 128, 3), 150, np.uint8)
CARS = np.array([[40.0, 30, 24, 11, 0.4], [90.0, 60, 24, 11, 2.0]])


def test_a_dark_car_is_dark_within_its_box_alone() -> None:
    darkened = darken_cars(np.random.default_rng(1), GREY, np.repeat(CARS, 4, axis=0))
    assert (darkened[[30, 60], [40, 90]] < 100).all()
    assert (darkened[:10] == 150).all()


@pytest.mark.parametrize("boxes", [CARS, CARS[:0]])
def test_shade_is_seeded_and_leaves_most_crops_alone(boxes: np.ndarray) -> None:
    first, again = ([shaded(np.random.default_rng(k), GREY, boxes) for k in range(60)] for _ in range(2))
    assert all((a == b).all() for a, b in zip(first, again, strict=True))
    untouched = np.mean([(image == GREY).all() for image in first])
    assert 0.4 < untouched < 0.8
