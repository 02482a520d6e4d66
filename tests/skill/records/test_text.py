from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vehanchor.records.text import significant, with_interval


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.12, "0.120"),
        (12.0, "12.0"),
        (300.0, "300"),
        (9.996, "10.0"),
        (1234.5, "1234"),
        (0.00012, "0.000120"),
        (0, "0"),
    ],
)
def test_zeros_are_kept_and_whole_digits_too(value: float, text: str) -> None:
    assert significant(value) == text


@given(st.floats(1e-6, 1e9), st.integers(1, 6))
def test_it_is_the_number_within_half_a_digit_and_has_no_exponent(value: float, digits: int) -> None:
    assume(math.isfinite(value))
    text = significant(value, digits)
    assert "e" not in text
    assert len(text.replace(".", "").lstrip("0")) >= digits
    assert float(text) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits))


def test_an_interval_follows_its_value() -> None:
    assert with_interval(0.12, 0.1, 0.15, "m/px") == "0.1200 m/px  (95 %: 0.1000 to 0.1500)"
    assert with_interval(12, None, 15, "m") == "12.00 m"
