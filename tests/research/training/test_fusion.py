"""The votes of boxes are fitted to the errors of their lengths."""

from __future__ import annotations

import numpy as np
import pytest

from research.training.fusion.fit import Boxes, fit_votes


def test_the_log_odds_under_which_boxes_were_cars_are_found_again() -> None:
    rng = np.random.default_rng(4)
    n = 20_000
    scores = rng.uniform(0.2, 1.0, n)
    is_car = rng.random(n) < 1 / (1 + np.exp(6.0 - 9.0 * scores))
    of_other_things = rng.uniform(-0.5, 0.5, n)
    log_errors = np.where(is_car, rng.normal(0.0, 0.1, n), of_other_things)
    votes = fit_votes(Boxes(scores, log_errors, np.full(n, 0.1), np.ones(n)))
    assert votes == pytest.approx((-6.0, 9.0), rel=0.1)
