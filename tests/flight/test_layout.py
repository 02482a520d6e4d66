from __future__ import annotations

import numpy as np
import pytest

from vehanchor_flight.layout import Seam, lay_out

CENTRES, DIAGONALS = np.full((9, 2), (500.0, 400.0)), np.full(9, 1280.0)
STEP_PX = 300.0


def _seam(first: int, second: int, shift_px: float, turn_deg: float = 0.0) -> Seam:
    """The second photograph lies ``shift_px`` to the right of the first."""
    turn = np.radians(turn_deg)
    matrix = np.array([[np.cos(turn), -np.sin(turn), -shift_px], [np.sin(turn), np.cos(turn), 0.0]])
    return Seam(first, second, matrix, 100.0)


def test_one_wrong_overlap_does_not_bend_a_strip_and_is_told() -> None:
    strip = [_seam(k, k + step, STEP_PX * step) for step in (1, 2) for k in range(9 - step)]
    wrong = Seam(0, 8, _seam(0, 8, 100.0, turn_deg=30.0).turn, 30.0)
    layout = lay_out(CENTRES, DIAGONALS, np.zeros(9), 0, [*strip, wrong])
    assert layout.feet.real == pytest.approx(STEP_PX * np.arange(9), abs=3.0)
    assert np.abs(layout.feet.imag).max() < 3.0
    assert layout.off[-1] > 1.0
    assert layout.off[:-1].max() < 0.01


def test_a_component_of_one_photograph_lies_at_zero() -> None:
    layout = lay_out(CENTRES[:1], DIAGONALS[:1], np.zeros(1), 0, [])
    assert layout.feet.tolist() == [0]
    assert len(layout.off) == 0
