"""Chances and their log odds."""

from __future__ import annotations

import numpy as np
import pytest

from vehanchor.odds import chance_of, chances_of, log_odds_of


@pytest.mark.parametrize("chance", [1e-9, 0.25, 0.5, 0.999])
def test_log_odds_lead_back_to_their_chance(chance: float) -> None:
    assert chance_of(log_odds_of(chance)) == pytest.approx(chance)


def test_extreme_log_odds_do_not_overflow() -> None:
    extremes = np.array([-1e6, 1e6])
    assert chances_of(extremes).tolist() == [pytest.approx(0.0), 1.0]
    assert chance_of(-1e6) == pytest.approx(0.0)


def test_one_log_odds_has_the_chance_of_many() -> None:
    log_odds = np.linspace(-30.0, 30.0, 13)
    expected = [chance_of(value) for value in log_odds.tolist()]
    assert chances_of(log_odds) == pytest.approx(expected)
