"""What the ground's density says of a candidate's size, and what the search makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from research.scenes import render_scene
from vehanchor.detection.detector import Detector
from vehanchor.detection.scene_scale import SceneCalibration, SceneLevel, SceneScalePrior
from vehanchor.detection.search import search
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.fusion import credible_interval

_CALIBRATION = SceneCalibration(np.log(0.01), 0.08, floor=0.02)


def _ground(gsd_m_per_px: float, log_sd: float) -> SceneScalePrior:
    bins = np.arange(60) * _CALIBRATION.log_step + _CALIBRATION.first_log_gsd
    return SceneScalePrior((SceneLevel(1, 9, -0.5 * ((bins - np.log(gsd_m_per_px)) / log_sd) ** 2),), _CALIBRATION)


def test_a_cars_size_is_likely_and_that_of_another_thing_is_not() -> None:
    odds = _ground(0.15, 0.15).size_odds(CAR_LENGTH_M / np.array([0.15, 0.17, 0.5, 0.03]))
    assert (odds[:2] > 0.5).all()
    assert (odds[2:] == -2).all()  # no more: the ground may be wrong


@pytest.mark.parametrize(("gsd", "wider"), [(0.06, 1.55), (0.6, 1.0)])
def test_a_sharp_place_may_be_finer_than_it_looks(gsd: float, wider: float) -> None:
    """The interval opens downwards only, and only where few places trained the network."""
    plain = credible_interval(_ground(gsd, 0.15).density)
    open_prior = SceneScalePrior(_ground(gsd, 0.15).levels, replace(_CALIBRATION, finer=0.2))
    low, high = credible_interval(open_prior.density)
    assert open_prior.density.sum() == pytest.approx(1)
    assert plain.low / low == pytest.approx(wider, rel=0.15)
    assert high == pytest.approx(plain.high, rel=0.03)


def test_ground_that_is_lost_prefers_no_size() -> None:
    odds = _ground(0.1, 5.0).size_odds(CAR_LENGTH_M / np.geomspace(0.03, 0.5, 9))
    assert np.ptp(odds) < 0.1
    assert (np.abs(odds) < 1.3).all()


@pytest.mark.parametrize(("said", "more"), [(0.12, True), (0.5, False)])
def test_the_grounds_word_moves_the_scores_of_the_bundled_detector(said: float, more: bool) -> None:
    scene = render_scene(0.12, width_px=500, height_px=400, seed=3, layout="parking")
    detector = Detector(resolve_model(), runtime=Runtime(threads=1))
    with open_raster(scene.image) as raster:
        alone, told = (
            search(raster, detector, Search(min_score=0.3, search_scales=False), prior=ground)
            for ground in (None, _ground(said, 0.15))
        )
    assert len(alone.boxes) > 20
    assert bool(np.median(told.scores[:20]) > np.median(alone.scores[:20])) is more
