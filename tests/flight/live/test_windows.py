from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor_flight.live.windows import WINDOW_PX, next_window, reduction_factor

SIDES = st.integers(16, 5000)


@given(SIDES, SIDES, st.floats(0.003, 3), st.integers(0, 50), st.lists(st.tuples(SIDES, SIDES), max_size=9))
def test_a_window_lies_in_the_reduced_frame(
    width: int, height: int, gsd: float, turn: int, cars: list[tuple[int, int]]
) -> None:
    factor = reduction_factor(gsd, width, height)
    window = next_window(width, height, factor, turn, np.array(cars, np.float64).reshape(-1, 2))
    assert 0 <= window.x_px <= window.x_px + window.width_px <= width // factor
    assert 0 <= window.y_px <= window.y_px + window.height_px <= height // factor
    assert 0 < max(window.width_px, window.height_px) <= WINDOW_PX


def test_the_window_with_the_most_cars_is_searched_and_others_now_and_then() -> None:
    cars = np.array([[1000.0, 500.0], [1050.0, 520.0], [100.0, 100.0]])
    windows = [next_window(1280, 720, 1, turn, cars) for turn in range(8)]
    holds = [each.x_px <= 1000 and each.x_px + each.width_px > 1050 and each.y_px <= 500 for each in windows]
    assert sum(holds) >= 6
    assert len(set(windows)) > 1


@pytest.mark.parametrize(("gsd", "factor"), [(None, 1), (0.3, 1), (0.05, 2), (0.03, 4), (0.005, 4)])
def test_the_frame_is_reduced_until_cars_have_a_known_length(gsd: float | None, factor: int) -> None:
    assert reduction_factor(gsd, 1280, 720) == factor
