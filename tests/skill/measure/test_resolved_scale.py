from __future__ import annotations

import math

import numpy as np
import pytest

from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.resolved_scale import CameraAbove, ResolvedScale, camera_above, raised
from vehanchor.measure.spread import Spread
from vehanchor.options import ScaleOptions
from vehanchor.scale.reliability import RELIABILITY


def test_a_given_height_has_the_spread_that_the_ruler_gives_it() -> None:
    with open_raster(np.zeros((300, 400, 3), np.uint8)) as raster:
        camera = camera_above(raster, ScaleOptions.of({"height_m": 50.0}), 10.0)
    found = ResolvedScale(0.1, Spread(), None, "given", None, ())
    assert raised(found, 10.0, camera).spread == pytest.approx([10 / 40 * RELIABILITY["measured height"].log_sd] * 2)


def test_a_skewed_interval_stays_skewed_at_the_height_of_the_object() -> None:
    ground = Spread.of_interval(0.136, 0.121, 0.185)
    assert ground.around(0.136) == pytest.approx((0.121, 0.185))
    found = ResolvedScale(0.136, ground, 0.9, "estimated", None, ())
    above = raised(found, 10.0, CameraAbove(None, 50.0, 0.05))
    assert above.gsd_m_per_px == pytest.approx(0.136 * 0.8)
    low, high = above.spread.around(0.136 * 0.8)
    assert low < 0.121 * 0.8 < 0.185 * 0.8 < high
    assert above.spread == pytest.approx([math.hypot(side, 0.25 * 0.05) for side in ground])


@pytest.mark.parametrize(("low", "high"), [(None, None), (None, 0.2), (0.2, 0.1)])
def test_without_an_interval_nothing_is_made_up(low: float | None, high: float | None) -> None:
    assert Spread.of_interval(0.15, low, high) == Spread()
