from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from research.scenes import Layout, Scene, render_scene
from tests.analyses import log_sd, made_card, measured, told
from vehanchor.detection.detections import NOT_SEARCHED, Detections
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.bay_rows import BayRow, find_bay_rows
from vehanchor.rulers.parking_bays import ParkingBays, witness_of
from vehanchor.rulers.ruler import View
from vehanchor.scale.lengths import Interval


def _row(pitch_px: float, n: int = 8) -> BayRow:
    x = 100 + pitch_px * np.arange(n)
    ends = np.stack([np.stack([x, np.full(n, 100.0)], axis=1), np.stack([x, np.full(n, 150.0)], axis=1)], axis=1)
    return BayRow(ends, pitch_px, 0.002, 50.0)


def test_the_width_of_bays_makes_a_scale_whose_interval_holds_the_widths_of_many_countries() -> None:
    witness = told(witness_of([_row(25.0), _row(25.2)]))
    assert witness.interval is not None
    for width_m in (2.4, 2.5, 2.59, 2.743):
        assert witness.interval.low < width_m / 25.1 < witness.interval.high
    assert (witness.n, witness.kind) == (16, "parking_bays")
    assert witness.said is not None
    assert "16 lines of parking bays" in witness.said


def test_a_country_chooses_the_width() -> None:
    american, german, anywhere = (told(witness_of([_row(25.0)], region)) for region in ("US", "DE", None))
    assert american.gsd_m_per_px == pytest.approx(2.664 / 25, rel=1e-3)  # between 8.5 and 9 feet
    assert german.gsd_m_per_px == pytest.approx(2.5 / 25, rel=1e-3)
    assert log_sd(american) < log_sd(anywhere)


def test_a_row_of_another_width_is_left_out() -> None:
    alone, beside = told(witness_of([_row(25.0)])), told(witness_of([_row(25.0), _row(35.0, 6)]))
    assert beside.gsd_m_per_px == alone.gsd_m_per_px
    assert beside.n == 8


def test_the_marks_show_the_lines_and_one_width() -> None:
    width, *lines = told(witness_of([_row(25.0)])).marks
    assert width.label == "bay"
    assert len(lines) == 8
    (x0, y0), (x1, y1) = width.points
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(25.0)
    assert 100 <= x1 <= 275


def test_without_rows_or_without_pixels_or_without_a_prior_there_is_no_evidence() -> None:
    assert witness_of([]) is None
    view = View(ImageFacts(1000, 800), NOT_SEARCHED, made_card(5.0), ScaleOptions(), lambda *_: 1.0)
    assert ParkingBays().measure(view) is None


def test_an_empty_car_park_has_a_scale() -> None:
    scene = render_scene(0.2, width_px=700, height_px=700, seed=5, n_vehicles=0, layout="parking")
    with open_raster(scene.image) as raster:
        facts = ImageFacts(700, 700)
        view = View(facts, NOT_SEARCHED, made_card(5.0), ScaleOptions(), lambda *_: 1.0, raster=raster)
        witness = measured(ParkingBays(), replace(view, prior=load_scene_scale().predict(raster)))
    assert witness.gsd_m_per_px == pytest.approx(0.2, rel=0.06)
    assert witness.interval is not None
    assert witness.interval.low < 0.2 < witness.interval.high


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
    [
        pytest.param(0.04, 1800, 5, marks=pytest.mark.slow),
        pytest.param(0.06, 1400, 3, marks=pytest.mark.slow),
        (0.1, 1000, 3),
        (0.2, 600, 3),
    ],
)
def test_rows_of_bays_are_measured_to_half_a_percent(gsd: float, side_px: int, seed: int) -> None:
    rows = _found(_scene(gsd, side_px, seed))
    assert rows
    for row in rows:
        assert row.pitch_px * gsd == pytest.approx(WIDTH_M, rel=0.005)
        assert row.pitch_log_sd < 0.005
        assert len(row.ends) >= 6


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


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_countryside_has_no_bays(seed: int) -> None:
    """Vineyards, fields and orchards have rows, too."""
    assert _found(_scene(0.15, 900, seed, "countryside")) == []


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
