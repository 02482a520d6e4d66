from __future__ import annotations

import math

import numpy as np
import pytest

from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.resolved_scale import ResolvedScale, camera_above, raised
from vehanchor.options import ScaleOptions
from vehanchor.scale.height import GIVEN_HEIGHT_LOG_SD


def test_a_given_height_has_the_spread_that_the_ruler_gives_it() -> None:
    with open_raster(np.zeros((300, 400, 3), np.uint8)) as raster:
        camera = camera_above(raster, ScaleOptions.of({"height_m": 50.0}), 10.0)
    found = ResolvedScale(0.1, 0.0, None, "given", None, ())
    assert raised(found, 10.0, camera).log_sd == pytest.approx(10 / 40 * GIVEN_HEIGHT_LOG_SD)
    assert math.isclose(GIVEN_HEIGHT_LOG_SD, 0.05)
