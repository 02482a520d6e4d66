"""Chance that vehicles are equal things: graves, boats or carts in rows."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
import pytest

from vehanchor.detection.detections import Appearance
from vehanchor.detection.detector_errors import DetectorErrors
from vehanchor.rulers.look_alikes import (
    chance_of_look_alikes,
    chance_of_things,
    end_evidence,
    heading_evidence,
    proportion_evidence,
    spread_evidence,
)

ERRORS = DetectorErrors()
LOOK_ALIKES = ERRORS.look_alikes
USUAL = ERRORS.appearance.length_over_width


def _normal(n: int, sd: float) -> np.ndarray:
    """Quantiles of a normal distribution."""
    deviates = [NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)]
    return sd * np.array(deviates)


def _boxes(log_lengths: np.ndarray, ratio: float = USUAL) -> np.ndarray:
    """Parallel boxes of these lengths."""
    boxes = np.zeros((len(log_lengths), 5))
    boxes[:, 2] = np.exp(log_lengths)
    boxes[:, 3] = boxes[:, 2] / ratio
    return boxes


def _chance(
    n: int,
    *,
    spread: float,
    tone_sd: float,
    logit: float,
    ratio: float = USUAL,
    lightness: float = 120.0,
) -> float:
    """Chance of n vehicles, whose appearances spread by two thirds of their lengths."""
    appearance = Appearance(
        np.log(4.4) + _normal(n, spread / 1.5),
        np.full(n, 0.07),
        logits=np.full(n, logit),
        tones=np.column_stack([lightness + _normal(n, tone_sd), np.full((n, 2), 128.0)]),
    )
    boxes = _boxes(np.log(40) + _normal(n, spread), ratio)
    return chance_of_look_alikes(boxes, appearance, ERRORS, undistorted=True)


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
    usual = {"spread": 0.04, "tone_sd": 5.0, "logit": 2.6}
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
        ({"ratio": 2.5}, {"ratio": 2.2}),
    ],
)
def test_each_sign_raises_the_chance(unlike: dict[str, float], alike: dict[str, float]) -> None:
    usual = {"spread": 0.06, "tone_sd": 20.0, "logit": 2.8}
    assert _chance(8, **usual | alike) > 2 * _chance(8, **usual | unlike)


def test_without_tones_fewer_things_are_doubted() -> None:
    boxes = _boxes(np.log(40) + _normal(8, 0.03))
    looks = np.log(4.4) + _normal(8, 0.03)
    appearance = Appearance(looks, np.full(8, 0.07), np.full(8, 2.4))
    assert chance_of_look_alikes(boxes, appearance, ERRORS, undistorted=True) < _things(8)


def test_a_spread_is_known_better_from_more_vehicles() -> None:
    few = spread_evidence(_normal(3, 0.04), LOOK_ALIKES.lengths)
    many = spread_evidence(_normal(30, 0.04), LOOK_ALIKES.lengths)
    assert 0 < few < many


def test_equal_numbers_are_finite_evidence() -> None:
    assert np.isfinite(spread_evidence(np.zeros(64), LOOK_ALIKES.lengths))


def _with_shadows(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Log lengths that are greatest along a shadow at 0.4 rad, and their directions."""
    headings = np.linspace(0.0, np.pi, n, endpoint=False)
    trend = 0.2 * np.cos(2 * (headings - 0.4))
    return trend + np.tile([-0.05, 0.05], n)[:n], headings


def test_boxes_that_are_longer_along_a_shadow_are_doubted() -> None:
    log_lengths, headings = _with_shadows(12)
    assert heading_evidence(log_lengths, headings, LOOK_ALIKES.headings) > 3.0


def test_long_cars_among_cars_of_all_directions_show_no_shadow() -> None:
    log_lengths, headings = _with_shadows(12)
    # The same lengths, in an order that does not follow the directions.
    mixed = np.sort(log_lengths)[[0, 7, 3, 10, 1, 8, 4, 11, 2, 6, 9, 5]]
    assert heading_evidence(mixed, headings, LOOK_ALIKES.headings) < 0.5


def test_parallel_boxes_show_no_shadow() -> None:
    log_lengths, _ = _with_shadows(12)
    assert heading_evidence(log_lengths, np.zeros(12), LOOK_ALIKES.headings) == pytest.approx(0.0)


def test_short_bodies_are_clearer_evidence_than_usual_ones_are_against() -> None:
    bodies = _boxes(np.full(8, 3.7), 2.15)
    cars = _boxes(np.full(8, 3.7))
    errors = LOOK_ALIKES.proportions
    assert proportion_evidence(bodies, errors, USUAL) > 4.0
    assert -0.7 < proportion_evidence(cars, errors, USUAL) < 0.0


def test_a_tilted_view_shows_no_proportions() -> None:
    log_lengths, headings = _with_shadows(12)
    boxes = _boxes(log_lengths + 3.7, 2.21)
    boxes[:, 4] = headings
    appearance = Appearance(log_lengths, np.full(12, 0.07), np.full(12, 3.4))
    at_nadir = chance_of_look_alikes(boxes, appearance, ERRORS, undistorted=True)
    tilted = chance_of_look_alikes(boxes, appearance, ERRORS, undistorted=False)
    assert tilted < 0.01 * at_nadir


def _paints(n: int) -> np.ndarray:
    """Colours of n cars of different paints, as bright as dark."""
    return np.column_stack([110 + _normal(n, 45.0), np.full((n, 2), 128.0)])


def test_ends_of_one_tone_beside_ends_of_all_paints_are_shadows() -> None:
    paints = _paints(10)
    shadow = np.tile([60.0, 128.0, 128.0], (10, 1))
    headings = np.zeros(10)
    with_shadows = end_evidence(np.stack([paints, shadow], 1), headings, LOOK_ALIKES.ends)
    of_cars = end_evidence(np.stack([paints, paints], 1), headings, LOOK_ALIKES.ends)
    assert with_shadows > 3.0
    assert 0.0 <= of_cars < 0.2


def test_shadows_lie_on_one_side_of_the_image_whatever_way_a_box_is_turned() -> None:
    shadow = np.tile([60.0, 128.0, 128.0], (10, 1))
    ends = np.stack([_paints(10), shadow], 1)
    every_second = slice(None, None, 2)
    turned = ends.copy()
    turned[every_second] = ends[every_second, ::-1]
    headings = np.zeros(10)
    headings[every_second] = np.pi
    expected = end_evidence(ends, np.zeros(10), LOOK_ALIKES.ends)
    assert end_evidence(turned, headings, LOOK_ALIKES.ends) == pytest.approx(expected)


def test_cars_of_one_paint_have_no_shadows() -> None:
    white = np.tile([230.0, 128.0, 128.0], (10, 2)).reshape(10, 2, 3)
    shadow = white.copy()
    shadow[:, 0] = np.column_stack([_paints(10)])
    headings = np.zeros(10)
    alike = end_evidence(white, headings, LOOK_ALIKES.ends)
    assert alike < end_evidence(shadow, headings, LOOK_ALIKES.ends)


def test_many_doubtful_things_are_surer_than_one() -> None:
    assert chance_of_things(np.full(1, -2.7), 1) == 0.0
    assert chance_of_things(np.full(8, -2.7), 8) > 0.5


def test_no_number_of_clear_cars_is_things() -> None:
    assert chance_of_things(np.full(64, -9.0), 500) == 0.0


def test_no_examined_vehicle_shows_no_things() -> None:
    assert chance_of_things(np.zeros(0), 3) == 0.0
