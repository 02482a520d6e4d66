from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from research.scenes import render_scene
from tests.analyses import log_sd, made_card
from vehanchor.detection.detections import NOT_SEARCHED
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.bay_rows import BayRow
from vehanchor.rulers.parking_bays import ParkingBays, witness_of
from vehanchor.rulers.view import View


def _row(pitch_px: float, n: int = 8) -> BayRow:
    x = 100 + pitch_px * np.arange(n)
    ends = np.stack([np.stack([x, np.full(n, 100.0)], axis=1), np.stack([x, np.full(n, 150.0)], axis=1)], axis=1)
    return BayRow(ends, pitch_px, 0.002, 50.0)


def test_the_width_of_bays_makes_a_scale_whose_interval_holds_the_widths_of_many_countries() -> None:
    witness = witness_of([_row(25.0), _row(25.2)])
    assert witness.interval is not None
    for width_m in (2.4, 2.5, 2.59, 2.743):
        assert witness.interval.low < width_m / 25.1 < witness.interval.high
    assert (witness.n, witness.kind) == (16, "parking_bays")
    assert witness.said is not None
    assert "16 lines of parking bays" in witness.said


def test_a_country_chooses_the_width() -> None:
    american, german, anywhere = (witness_of([_row(25.0)], region) for region in ("US", "DE", None))
    assert american.gsd_m_per_px == pytest.approx(2.664 / 25, rel=1e-3)  # between 8.5 and 9 feet
    assert german.gsd_m_per_px == pytest.approx(2.5 / 25, rel=1e-3)
    assert log_sd(american) < log_sd(anywhere)


def test_a_row_of_another_width_is_left_out() -> None:
    alone, beside = witness_of([_row(25.0)]), witness_of([_row(25.0), _row(35.0, 6)])
    assert beside.gsd_m_per_px == alone.gsd_m_per_px
    assert beside.n == 8


def test_the_marks_show_the_lines_and_one_width() -> None:
    width, *lines = witness_of([_row(25.0)]).marks
    assert width.label == "bay"
    assert len(lines) == 8
    (x0, y0), (x1, y1) = width.points
    assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(25.0)
    assert 100 <= x1 <= 275


def test_without_rows_or_without_pixels_or_without_a_prior_there_is_no_evidence() -> None:
    assert not witness_of([]).found
    view = View(ImageFacts(1000, 800), NOT_SEARCHED, made_card(5.0), ScaleOptions(), lambda *_: 1.0)
    assert not ParkingBays().measure(view).found


def test_an_empty_car_park_has_a_scale() -> None:
    scene = render_scene(0.2, width_px=700, height_px=700, seed=5, n_vehicles=0, layout="parking")
    with open_raster(scene.image) as raster:
        network = load_scene_scale()
        assert network is not None
        facts = ImageFacts(700, 700)
        view = View(facts, NOT_SEARCHED, made_card(5.0), ScaleOptions(), lambda *_: 1.0, raster=raster)
        witness = ParkingBays().measure(replace(view, prior=network.predict(raster)))
    assert witness.gsd_m_per_px == pytest.approx(0.2, rel=0.06)
    assert witness.interval is not None
    assert witness.interval.low < 0.2 < witness.interval.high
