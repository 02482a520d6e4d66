from __future__ import annotations

import numpy as np
import pytest

from tests.analyses import make_analysis
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.pictures.scale import DROPPED_RGB, KEPT_RGB
from vehanchor.pictures.vehicle_strip import MAX_SHOWN, draw_vehicle_strip


def strip_of(n_vehicles: int) -> np.ndarray:
    image = np.full((400, 400, 3), 100, np.uint8)
    boxes = [[20.0 + 12 * i, 200.0, 30.0, 12.0, 0.0] for i in range(n_vehicles)]
    analysis = make_analysis(np.array(boxes).reshape(-1, 5), 400, 400)
    with open_raster(image) as raster:
        return draw_vehicle_strip(raster, analysis, 512)


def is_near(picture: np.ndarray, rgb: tuple[int, int, int]) -> np.ndarray:
    difference = np.abs(picture.astype(int) - rgb)
    near: np.ndarray = difference.max(2) < 60
    return near


@pytest.fixture(scope="module")
def strip() -> np.ndarray:
    """Strip of five vehicles, in a row of four and a row of one."""
    return strip_of(5)


def test_the_strip_has_rows_of_vehicles(strip: np.ndarray) -> None:
    assert strip.shape == (256, 512, 3)
    assert not strip[128:, 128:].any(), "the second row has one vehicle"


@pytest.mark.parametrize("left", range(0, 512, 128))
def test_each_vehicle_has_its_box(strip: np.ndarray, left: int) -> None:
    assert is_near(strip[:128, left : left + 128], KEPT_RGB).any()


@pytest.mark.parametrize("left", range(0, 512, 128))
def test_each_vehicle_has_its_number(strip: np.ndarray, left: int) -> None:
    assert (strip[:24, left : left + 24] == 255).all(2).any()


def test_no_kept_vehicle_is_drawn_as_dropped(strip: np.ndarray) -> None:
    assert not is_near(strip, DROPPED_RGB).any()


def test_many_vehicles_are_cut_off() -> None:
    assert strip_of(30).shape[0] == MAX_SHOWN // 4 * 128


def test_a_part_has_its_own_vehicles_alone() -> None:
    image = np.full((400, 400, 3), 100, np.uint8)
    boxes = np.array([[50.0, 50.0, 30.0, 12.0, 0.0], [300.0, 300.0, 30.0, 12.0, 0.0]])
    analysis = make_analysis(boxes, 400, 400)
    part = Window(200, 200, width_px=200, height_px=200)
    with open_raster(image) as raster:
        strip = draw_vehicle_strip(raster, analysis, 512, within=part)
    assert is_near(strip[:, :128], KEPT_RGB).any()
    assert not strip[:, 128:].any()


def test_a_strip_without_vehicles_has_no_rows() -> None:
    assert strip_of(0).shape == (0, 512, 3)
