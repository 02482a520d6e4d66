"""Pages have no scale, and lettering over a photograph does not change its scale."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import Layout, render_scene
from research.scenes.captions import CAPTIONS
from research.scenes.lettering import own_fonts
from research.scenes.pages import PAGES
from vehanchor import estimate_gsd


@cache
def _scene(layout: Layout | None = None, n_vehicles: int | None = None) -> NDArray[np.uint8]:
    return render_scene(
        0.1, width_px=640, height_px=512, seed=3, layout=layout, n_vehicles=n_vehicles
    ).image


@pytest.mark.parametrize("kind", ["page", "chart"])
def test_a_picture_that_is_no_photograph_has_no_scale(kind: str) -> None:
    picture = PAGES[kind](np.random.default_rng(1), own_fonts())
    estimate = estimate_gsd(picture)
    assert estimate.status == "no_scale"
    assert estimate.reason == "no_photograph"
    assert "no_photograph" in [notice.code for notice in estimate.warnings]


def test_a_line_of_known_length_sets_the_scale_of_a_page() -> None:
    picture = PAGES["plan"](np.random.default_rng(1), own_fonts())
    line = (10, 10, 210, 10, 20.0, "measured")
    estimate = estimate_gsd(picture, known_lengths=[line])
    assert estimate.gsd_m_per_px == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("kind", ["caption", "display", "program"])
def test_lettering_does_not_change_the_scale_of_a_car_park(kind: str) -> None:
    scene = _scene("parking")
    bare = estimate_gsd(scene)
    lettered = estimate_gsd(CAPTIONS[kind](scene, np.random.default_rng(2), own_fonts()))
    assert bare.status == lettered.status == "ok"
    assert lettered.gsd_m_per_px == pytest.approx(bare.gsd_m_per_px, rel=0.02)


@pytest.mark.parametrize("kind", ["caption", "labels", "display"])
def test_lettering_over_an_empty_scene_has_no_usable_scale(kind: str) -> None:
    scene = _scene(n_vehicles=0)
    lettered = CAPTIONS[kind](scene, np.random.default_rng(2), own_fonts())
    assert estimate_gsd(lettered).status != "ok"
