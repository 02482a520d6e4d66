from __future__ import annotations

import numpy as np

from tests.analyses import make_analysis
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.scale import DROPPED_RGB, KEPT_RGB
from vehanchor.pictures.vehicle_strip import MAX_SHOWN, draw_vehicle_strip


def strip_of(n_vehicles: int) -> np.ndarray:
    image = np.full((400, 400, 3), 100, np.uint8)
    boxes = np.array([[20.0 + 12 * i, 200.0, 30.0, 12.0, 0.0] for i in range(n_vehicles)]).reshape(
        -1, 5
    )
    with open_raster(image) as raster:
        return draw_vehicle_strip(raster, make_analysis(boxes, 400, 400), 512)


def is_near(picture: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
    found: np.ndarray = np.abs(picture.astype(int) - rgb).max(2) < 60
    return found


def test_each_vehicle_is_enlarged_with_its_box_and_number_in_rows() -> None:
    strip = strip_of(5)
    assert strip.shape == (256, 512, 3)
    for left in range(0, 512, 128):
        assert is_near(strip[:128, left : left + 128], KEPT_RGB).any()
        assert (strip[:24, left : left + 24] == 255).all(2).any(), "its number"
    assert not strip[128:, 128:].any(), "the second row has one vehicle"
    assert not is_near(strip, DROPPED_RGB).any()


def test_many_vehicles_are_cut_off_and_none_is_no_picture() -> None:
    assert strip_of(30).shape[0] == MAX_SHOWN // 4 * 128
    assert strip_of(0).shape == (0, 512, 3)
