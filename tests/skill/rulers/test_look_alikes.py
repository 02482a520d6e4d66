"""Chance that vehicles are equal things: graves, boats or carts in rows."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from vehanchor.detection.detections import Appearance
from vehanchor.detection.detector_errors import LookAlikeErrors
from vehanchor.rulers.look_alikes import chance_of_look_alikes, spread_evidence

ERRORS = LookAlikeErrors()


def _normal(n: int, sd: float) -> np.ndarray:
    """Quantiles of a normal distribution."""
    deviates = [NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)]
    return sd * np.array(deviates)


def _chance(
    n: int, *, spread: float, tone_sd: float, logit: float, lightness: float = 120.0
) -> float:
    """Chance of n vehicles, whose appearances spread by two thirds of their lengths."""
    appearance = Appearance(
        np.log(4.4) + _normal(n, spread / 1.5),
        np.full(n, 0.07),
        logits=np.full(n, logit),
        tones=np.column_stack([lightness + _normal(n, tone_sd), np.full((n, 2), 128.0)]),
    )
    return chance_of_look_alikes(np.log(40) + _normal(n, spread), appearance, ERRORS)


def _cars(n: int) -> float:
    return _chance(n, spread=0.105, tone_sd=41.0, logit=3.4)


def _things(n: int) -> float:
    return _chance(n, spread=0.03, tone_sd=6.0, logit=2.4)


@pytest.mark.parametrize("n", [1, 2, 4, 8, 19, 20, 64, 500])
def test_cars_are_hardly_doubted(n: int) -> None:
    assert _cars(n) < 0.01


@pytest.mark.parametrize("n", [5, 8, 19, 20, 64])
def test_equal_things_are_doubted_at_any_number(n: int) -> None:
    assert _things(n) > 0.9


def test_four_cars_of_one_model_and_different_paints_are_hardly_doubted() -> None:
    assert _chance(4, spread=0.03, tone_sd=30.0, logit=3.6) < 0.03


def test_two_equal_white_cars_are_hardly_doubted() -> None:
    assert _chance(2, spread=0.03, tone_sd=6.0, logit=3.8) < 0.03


def test_paints_tell_little_in_deep_shadow() -> None:
    usual = {"spread": 0.05, "tone_sd": 5.0, "logit": 2.9}
    assert _chance(4, **usual, lightness=80.0) > 0.5
    assert _chance(4, **usual, lightness=40.0) < 0.05


def test_a_single_vehicle_is_like_no_other() -> None:
    assert _things(1) < 0.01


def test_the_chance_has_no_step_in_the_number() -> None:
    log_odds = []
    for n in range(2, 40):
        chance = _things(n)
        log_odds.append(np.log(chance / (1 - chance)))
    steps = np.diff(log_odds)
    assert (steps >= 0).all()
    # The second vehicle is the first one that can be equal to another.
    assert steps.max() < 6.0


def test_the_chance_has_no_step_in_the_spread() -> None:
    spreads = np.linspace(0.02, 0.12, 200)
    chances = [_chance(10, spread=spread, tone_sd=20.0, logit=2.8) for spread in spreads]
    assert np.abs(np.diff(chances)).max() < 0.05


@pytest.mark.parametrize(
    ("unlike", "alike"),
    [
        ({"spread": 0.09}, {"spread": 0.04}),
        ({"tone_sd": 35.0}, {"tone_sd": 12.0}),
        ({"logit": 3.2}, {"logit": 2.4}),
    ],
)
def test_each_sign_raises_the_chance(unlike: dict[str, float], alike: dict[str, float]) -> None:
    usual = {"spread": 0.06, "tone_sd": 20.0, "logit": 2.8}
    assert _chance(8, **usual | alike) > 2 * _chance(8, **usual | unlike)


def test_without_tones_fewer_things_are_doubted() -> None:
    lengths = np.log(40) + _normal(8, 0.03)
    looks = np.log(4.4) + _normal(8, 0.03)
    appearance = Appearance(looks, np.full(8, 0.07), np.full(8, 2.4))
    assert chance_of_look_alikes(lengths, appearance, ERRORS) < _things(8)


def test_a_spread_is_known_better_from_more_vehicles() -> None:
    few = spread_evidence(_normal(3, 0.04), ERRORS.lengths)
    many = spread_evidence(_normal(30, 0.04), ERRORS.lengths)
    assert 0 < few < many


def test_equal_numbers_are_finite_evidence() -> None:
    assert np.isfinite(spread_evidence(np.zeros(64), ERRORS.lengths))
