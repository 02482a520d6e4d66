"""Straight edges at the ends of vehicles, below which a part of a car may be hidden."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.detection.hidden_ends import cut_chances, edge_strengths, hidden_errors

ENDS = np.array([[30.0, 66.0]])


def _chip(seed: int = 0) -> NDArray[np.uint8]:
    """A car of 36 x 16 px on asphalt with noise."""
    rng = np.random.default_rng(seed)
    chip = rng.normal(110, 5, (64, 96, 3))
    chip[24:40, 30:66] = (200, 200, 205)
    return chip.clip(0, 255).astype(np.uint8)


def _roofed(column: int, tone: int = 160) -> NDArray[np.uint8]:
    """The same car, hidden by a roof from a column on."""
    chip = _chip()
    chip[:, column:] = tone
    return chip


def _strength(chip: NDArray[np.uint8]) -> float:
    return float(edge_strengths(chip[None], ENDS)[0])


def test_a_roof_that_ends_at_the_car_is_an_edge() -> None:
    assert _strength(_roofed(66)) > 4 * _strength(_chip())


def test_a_roof_beyond_the_reach_of_the_end_is_no_edge() -> None:
    assert _strength(_roofed(80)) == pytest.approx(_strength(_chip()), abs=0.3)


def test_an_edge_beside_one_side_alone_is_weaker() -> None:
    chip = _chip()
    chip[:24, 66:] = 160
    assert _strength(chip) < 0.5 * _strength(_roofed(66))


def test_both_ends_are_examined() -> None:
    mirrored = _roofed(66)[:, ::-1]
    assert _strength(np.ascontiguousarray(mirrored)) > 4 * _strength(_chip())


def test_the_colours_of_the_car_are_no_edge() -> None:
    assert _strength(_chip()) < 1.0


def test_cars_beside_a_car_hide_no_edge() -> None:
    """Cars in a third of the rows have edges of their own."""
    chip = _roofed(66)
    chip[44:50, 20:66] = (40, 40, 45)
    assert _strength(chip) > 4 * _strength(_chip())


# --- Chance and error


WHOLE = 2.6
"""Length over width of a car."""


def _chance(strength: float, proportion: float) -> float:
    return float(cut_chances(np.array([strength]), np.array([proportion]))[0])


def test_a_short_body_at_an_edge_is_probably_cut() -> None:
    assert _chance(3.0, 1.9) > 0.9


def test_a_body_of_usual_proportions_is_hardly_ever_cut() -> None:
    assert _chance(0.5, WHOLE) < 0.01


@pytest.mark.parametrize(("strength", "proportion"), [(0.5, 2.2), (3.0, WHOLE)])
def test_proportions_or_an_edge_alone_are_doubtful(strength: float, proportion: float) -> None:
    assert _chance(strength, proportion) < 0.4


def test_a_cut_car_is_longer_than_it_seems_by_an_uncertain_part() -> None:
    means, log_sds = hidden_errors(np.zeros(3), np.array([0.0, 0.5, 1.0]))
    assert means == pytest.approx([0.0, 0.05, 0.1])
    assert log_sds[0] < 0.001 < log_sds[1]
    assert (log_sds[1:] > 0.09).all()


def test_the_error_rises_smoothly_with_the_edge() -> None:
    strengths = np.linspace(0, 5, 200)
    chances = cut_chances(strengths, np.full(200, 2.2))
    means, log_sds = hidden_errors(strengths, chances)
    assert (np.diff(chances) > 0).all()
    assert np.diff(means).max() < 0.01
    assert np.abs(np.diff(log_sds)).max() < 0.01
