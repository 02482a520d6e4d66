"""The votes of boxes are fitted to what happened."""

from __future__ import annotations

import numpy as np
import pytest

from research.training.fusion.fit import Boxes, fit_votes


def test_the_log_odds_under_which_boxes_were_cars_are_found_again() -> None:
    rng = np.random.default_rng(4)
    scores = rng.uniform(0.2, 1.0, 20_000)
    car = rng.random(len(scores)) < 1 / (1 + np.exp(6.0 - 9.0 * scores))
    votes = fit_votes(Boxes(scores, car, np.ones(len(scores))))
    assert votes == pytest.approx((-6.0, 9.0), rel=0.1)
