"""Lettering: pages and captions that the generator draws."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from research.scenes.captions import CAPTIONS
from research.scenes.degraded import degraded
from research.scenes.lettering import own_fonts
from research.scenes.pages import PAGES


@pytest.fixture(scope="module")
def scene() -> NDArray[np.uint8]:
    return render_scene(0.1, width_px=400, height_px=300, seed=3).image


@pytest.mark.parametrize("kind", sorted(PAGES))
def test_a_seed_draws_the_same_page_again(kind: str) -> None:
    first, again = (PAGES[kind](np.random.default_rng(5), own_fonts()) for _ in range(2))
    assert first.std() > 0
    assert np.array_equal(first, again)


@pytest.mark.parametrize("kind", sorted(CAPTIONS))
def test_lettering_leaves_most_of_the_photograph_as_it_is(
    kind: str, scene: NDArray[np.uint8]
) -> None:
    before = scene.copy()
    lettered = CAPTIONS[kind](scene, np.random.default_rng(5), own_fonts())
    assert np.array_equal(scene, before)
    changed = (lettered[:300, :400] != scene).any(axis=2).mean()
    assert changed < 0.4
    assert lettered.shape != scene.shape or changed > 0


@pytest.mark.parametrize("seed", range(8))
def test_a_degraded_page_keeps_its_size(seed: int) -> None:
    page = PAGES["chart"](np.random.default_rng(5), own_fonts())
    spoilt = degraded(page, np.random.default_rng(seed))
    assert spoilt.shape == page.shape
    assert (spoilt != page).any()
