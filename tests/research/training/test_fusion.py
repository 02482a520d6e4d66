"""The votes of boxes are fitted to what happened."""

from __future__ import annotations

import math

import numpy as np
import pytest

from research.training.fusion.fit import Boxes, Outcome, fit_votes, row


def test_the_log_odds_under_which_boxes_were_cars_are_found_again() -> None:
    rng = np.random.default_rng(4)
    scores = rng.uniform(0.2, 1.0, 20_000)
    car = rng.random(len(scores)) < 1 / (1 + np.exp(6.0 - 9.0 * scores))
    votes = fit_votes(Boxes(scores, car, np.ones(len(scores))))
    assert votes == pytest.approx((-6.0, 9.0), rel=0.1)


def test_a_row_of_the_report_counts_usable_and_wrong_scales() -> None:
    seen = [
        Outcome(3, True, 0.05, True),
        Outcome(3, True, 0.25, False),
        Outcome(2, False, 0.3, True),
        Outcome(1, False, 0.1, True),
        Outcome(0, False, math.nan, False),
    ]
    assert row("few", seen) == "| few | 5 | 2 | 1 | 97.5% | 17.5% | 0.750 |"
