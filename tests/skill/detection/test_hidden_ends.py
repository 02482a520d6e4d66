"""Straight edges at the ends of vehicles, below which a part of a car may be hidden."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vehanchor.detection.hidden_ends import edge_strengths, hidden_log_sds

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


def test_the_error_rises_smoothly_with_the_edge() -> None:
    log_sds = hidden_log_sds(np.linspace(0, 5, 200))
    steps = np.diff(log_sds)
    assert (steps > 0).all()
    assert steps.max() < 0.01


def test_without_an_edge_there_is_no_further_error() -> None:
    assert hidden_log_sds(np.array([0.5]))[0] < 0.002
