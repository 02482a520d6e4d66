from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.analyses import made_card
from tests.skill.rulers.test_penalty_areas import FULL
from tests.skill.rulers.test_penalty_areas import _drawn as draw_pitch
from vehanchor.detection.detections import NOT_SEARCHED
from vehanchor.detection.scene_scale import SceneCalibration, SceneLevel, SceneScalePrior
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.evidence import View
from vehanchor.rulers.penalty_areas import PenaltyArea
from vehanchor.rulers.pitches import Pitches


def _area(gsd: float, coverage: float = 0.95) -> PenaltyArea:
    corners = 50 + np.array([(0, 0), (40.32, 0), (40.32, 16.5), (0, 16.5)]) / gsd
    return PenaltyArea(corners, gsd, 0.001, coverage)


def _view(*areas: PenaltyArea) -> View:
    facts, options = ImageFacts(1000, 800), ScaleOptions.of({})
    return View(facts, NOT_SEARCHED, made_card(5.0), options, lambda *_: 1.0, found={"pitches": areas})


def test_areas_that_agree_make_one_scale() -> None:
    evidence = Pitches().measure(_view(_area(0.1), _area(0.102), _area(0.13, 0.8)))
    assert evidence.gsd_m_per_px == pytest.approx(math.sqrt(0.1 * 0.102))
    assert (evidence.n, evidence.kind) == (2, "pitches")
    assert evidence.explanation is not None
    assert "2 penalty areas say" in evidence.explanation
    assert evidence.interval is not None
    assert evidence.interval.low < 0.1 < 0.102 < evidence.interval.high


def test_the_marks_show_the_outline_and_two_sides() -> None:
    outline, front, side = Pitches().measure(_view(_area(0.1))).marks
    assert outline.closed
    assert (front.label, side.label) == ("40.32 m", "16.5 m")
    assert math.dist(*front.points) * 0.1 == pytest.approx(40.32)
    assert math.dist(*side.points) * 0.1 == pytest.approx(16.5)


def test_without_areas_or_without_pixels_there_is_no_evidence() -> None:
    assert Pitches().measure(_view()).gsd_m_per_px is None
    assert Pitches().measure(replace(_view(), found={})).gsd_m_per_px is None


def test_a_pitch_without_any_car_has_a_scale() -> None:
    bins = np.log(0.01) + 0.07 * np.arange(60)
    level = SceneLevel(1, 9, -0.5 * ((bins - np.log(0.15)) / 0.15) ** 2)
    prior = SceneScalePrior((level,), SceneCalibration(float(bins[0]), 0.07))
    with open_raster(draw_pitch(0.15, FULL)) as raster:
        evidence = Pitches().measure(replace(_view(), raster=raster, prior=prior, found={}))
    assert evidence.gsd_m_per_px == pytest.approx(0.15, rel=0.005)
    assert evidence.interval is not None
    assert evidence.interval.low < 0.15 < evidence.interval.high
