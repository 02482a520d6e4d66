"""Positions of a flight's photographs as a ruler."""

from __future__ import annotations

import numpy as np
import pytest

from vehanchor.rulers.positions import baseline

GSD = 0.07
WIDTH_PX = 4000.0


def test_two_or_more_photographs_in_a_line_give_the_scale() -> None:
    """Their layouts agree exactly; rounding may put the agreement above 1."""
    rng = np.random.default_rng(1)
    for n in (2, 3, 3, 5) * 50:
        turned = np.exp(1j * rng.uniform(0, 2 * np.pi))
        layout = (rng.uniform(0, 100) + 1e4 * np.arange(n)) * turned
        metres = GSD * layout * np.exp(1j * rng.uniform(0, 2 * np.pi))
        found = baseline(layout, np.column_stack([metres.real, -metres.imag]), WIDTH_PX)
        assert found is not None
        assert found.n == n
        assert found.gsd_m_per_px == pytest.approx(GSD)


def test_a_lag_on_opposite_headings_is_in_the_interval() -> None:
    headings = np.array([1.0, 1.0, -1.0, -1.0], np.complex128)
    layout = np.array([0.0, 300.0, 900.0, 1200.0], np.complex128)
    lag_m = 20.0
    metres = GSD * layout - lag_m * headings
    places = np.column_stack([metres.real, -metres.imag])
    by_headings = baseline(layout, places, 1000.0, headings=headings)
    without = baseline(layout, places, 1000.0)
    assert by_headings is not None
    assert without is not None
    assert by_headings.allows(GSD)
    assert not without.allows(GSD)
