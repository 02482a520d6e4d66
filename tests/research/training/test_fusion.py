"""The votes of boxes are fitted to what happened."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.fusion.fit import best_sharpness
from vehanchor.scale.fusion import recalibrated


@pytest.mark.parametrize("true", [1.0, 1.3, 1.8])
def test_the_certainty_under_which_chances_came_true_is_found_again(true: float) -> None:
    rng = np.random.default_rng(4)
    said = rng.uniform(0.3, 0.999, 20_000)
    right = rng.random(len(said)) < recalibrated(said, true)
    assert best_sharpness(said, right) == pytest.approx(true, abs=0.1)
