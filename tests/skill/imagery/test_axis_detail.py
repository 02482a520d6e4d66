"""Detail along the rows and the columns of an image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.flight.ground import ground
from vehanchor.imagery.axis_detail import measure_detail_difference
from vehanchor.imagery.sources.arrays import ArrayRaster

GROUND = ground(320, seed=3)


def _difference(pixels: NDArray[np.uint8]) -> float | None:
    return measure_detail_difference(ArrayRaster(np.ascontiguousarray(pixels), "array", None))


def _resized(columns: int, rows: int, interpolation: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(GROUND, (columns, rows), interpolation=interpolation), np.uint8)


def test_ground_has_as_much_detail_in_both_directions() -> None:
    difference = _difference(GROUND)
    assert difference is not None
    assert abs(difference) < 0.3


@pytest.mark.parametrize("interpolation", [cv2.INTER_LINEAR, cv2.INTER_CUBIC])
def test_a_wider_image_has_less_detail_along_its_rows(interpolation: int) -> None:
    wider = _difference(_resized(450, 320, interpolation))
    higher = _difference(_resized(320, 450, interpolation))
    assert wider is not None
    assert higher is not None
    assert wider < -0.6
    assert higher > 0.6


def test_an_image_without_texture_says_nothing() -> None:
    assert _difference(np.full((200, 200, 3), 90, np.uint8)) is None


def test_a_small_image_says_nothing() -> None:
    assert _difference(GROUND[:50]) is None
