from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from research.scenes import Layout, Scene, render_scene
from vehanchor.detection.detections import Detections
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.rulers.bay_lines import thin_lines
from vehanchor.rulers.bay_rows import BayRow, find_bay_rows
from vehanchor.scale.lengths import Interval

WIDTH_M = 2.5  # of the bays in rendered scenes, for cars of 4.6 m
ROUGHLY = 1.5  # factor by which the scale is unknown


@cache
def _scene(gsd: float, side_px: int, seed: int, layout: Layout = "parking") -> Scene:
    return render_scene(gsd, width_px=side_px, height_px=side_px, seed=seed, n_vehicles=0, layout=layout)


def _found(scene: Scene, guess: float = 1.0) -> list[BayRow]:
    gsd = scene.gsd_m_per_px * guess
    with open_raster(scene.image) as raster:
        return find_bay_rows(raster, Interval(gsd / ROUGHLY, gsd * ROUGHLY))


@pytest.mark.parametrize(
    ("gsd", "side_px", "seed"),
    [pytest.param(0.04, 1800, 5, marks=pytest.mark.slow), (0.06, 1400, 3), (0.1, 1000, 3), (0.2, 600, 3)],
)
def test_rows_of_bays_are_measured_to_half_a_percent(gsd: float, side_px: int, seed: int) -> None:
    rows = _found(_scene(gsd, side_px, seed))
    assert rows
    for row in rows:
        assert row.pitch_px * gsd == pytest.approx(WIDTH_M, rel=0.005)
        assert row.pitch_log_sd < 0.005
        assert len(row.ends) >= 6


def test_lines_of_a_row_lie_in_the_car_park() -> None:
    scene = _scene(0.1, 1000, 3)
    for row in _found(scene):
        columns, rows = np.clip(np.rint(row.ends.mean(axis=1)), 0, 999).astype(int).T
        assert (scene.masks["parking-lot"][rows, columns] > 0).all()


def test_rows_are_sought_only_where_the_search_went() -> None:
    scene = _scene(0.1, 1000, 3)
    tile = np.array([[0.0, 0.0, 600.0, 600.0]])
    reached, elsewhere = (
        Detections(np.zeros((0, 5)), np.zeros(0), areas=tile + shift, stopped_because="converged")
        for shift in (0, 5000)
    )
    scale = Interval(0.1 / ROUGHLY, 0.1 * ROUGHLY)
    with open_raster(scene.image) as raster:
        assert len(find_bay_rows(raster, scale, reached.covers)) == len(_found(scene)) > 0
        assert find_bay_rows(raster, scale, elsewhere.covers) == []


@pytest.mark.parametrize("guess", [1 / 1.35, 1.35])
def test_a_rough_scale_is_enough(guess: float) -> None:
    rows = _found(_scene(0.1, 1000, 3), guess)
    assert rows
    assert rows[0].pitch_px * 0.1 == pytest.approx(WIDTH_M, rel=0.005)


def test_at_another_scale_bays_are_no_bays() -> None:
    assert _found(_scene(0.1, 1000, 3), 4.0) == []
    assert _found(_scene(0.1, 1000, 3), 1 / 4) == []


@pytest.mark.parametrize("seed", range(3))
def test_the_countryside_has_no_bays(seed: int) -> None:
    """Vineyards, fields and orchards have rows, too."""
    assert _found(_scene(0.15, 900, seed, "countryside")) == []


def test_an_image_without_edges_has_no_lines() -> None:
    lines = thin_lines(np.full((50, 60), 90, np.uint8), 3.0, 10.0, 40.0)
    assert (lines.centres.shape, lines.angles.shape, lines.lengths.shape) == ((0, 2), (0,), (0,))


def test_a_line_is_found_in_its_middle() -> None:
    grey = np.full((80, 100), 90, np.uint8)
    grey[20:60, 49:52] = 200
    lines = thin_lines(grey, 6.0, 20.0, 60.0)
    assert lines.centres == pytest.approx(np.array([[50.0, 39.5]]), abs=0.6)
    assert lines.angles % math.pi == pytest.approx([math.pi / 2], abs=0.02)
    assert lines.lengths == pytest.approx([40], abs=4)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "width_m"),
    [("ucm_parkinglot25", 2.743), ("ucm_parkinglot34", 2.743), ("ucm_parkinglot58", 2.743)],  # 9 feet
)
def test_bays_of_an_american_car_park_are_nine_feet_wide(real_data: Path, name: str, width_m: float) -> None:
    with open_raster(real_data / f"vehicles/images/{name}.jpg") as raster:
        rows = find_bay_rows(raster, Interval(0.3048 / ROUGHLY, 0.3048 * ROUGHLY))
    assert rows
    assert float(np.median([row.pitch_px * 0.3048 for row in rows])) == pytest.approx(width_m, rel=0.02)


@pytest.mark.data
@pytest.mark.parametrize("name", ["parkinglot30", "parkinglot29"])
def test_a_hatched_walkway_is_no_row_of_bays(real_data: Path, name: str) -> None:
    with open_raster(real_data / f"vehicles/images/ucm_{name}.jpg") as raster:
        assert find_bay_rows(raster, Interval(0.3048 / ROUGHLY, 0.3048 * ROUGHLY)) == []
