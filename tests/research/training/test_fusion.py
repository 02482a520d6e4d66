"""The votes of boxes are fitted to what happened."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.fusion.fit import Outcomes, best_sharpness, told
from vehanchor.scale.fusion import recalibrated


@pytest.mark.parametrize("true", [1.0, 1.3, 1.8])
def test_the_certainty_under_which_chances_came_true_is_found_again(true: float) -> None:
    rng = np.random.default_rng(4)
    said = rng.uniform(0.3, 0.999, 20_000)
    right = rng.random(len(said)) < recalibrated(said, true)
    assert best_sharpness(said, right) == pytest.approx(true, abs=0.1)


def test_a_line_of_the_report_counts_usable_and_wrong_scales() -> None:
    error, width = np.array([0.05, 0.25, 0.3, 0.1, 0.5]), np.array([1.5, 1.5, 2.5, 1.5, 1.5])
    held, chance = np.array([True, False, True, True, True]), np.array([0.95, 0.95, 0.95, 0.7, 0.95])
    seen = Outcomes(np.zeros(5), held, width, chance, error)
    line = told("few", seen, chance, np.array([True, True, True, True, False]))
    assert "few: 2 of 4 usable, 1 wrong" in line
    assert "median error 17.5%" in line
    assert "cover 0.500 usable, 1.000 else" in line
