"""Scenes of cars that an edge cuts."""

from __future__ import annotations

import pytest

from research.scenes.covered import render_covered

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("cover", ["canopy", "shadow"])
def test_a_scene_has_the_cars_that_it_counts(cover: str) -> None:
    covered = render_covered(cover, 3)
    assert covered.n_cut <= len(covered.scene.vehicles) <= covered.n_cut + covered.n_whole
    assert 0.15 <= covered.hidden_share <= 0.55
