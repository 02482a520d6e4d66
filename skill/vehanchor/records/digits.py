"""Numbers as people read them: significant digits with their zeros, without an exponent."""

from __future__ import annotations


def significant(value: float, digits: int = 3) -> str:
    """Format a finite number with significant digits: 0.12 as ``0.120``, 1234.5 as ``1234``; 0 as ``0``.

    Zeros are kept, because they say how exactly the number is known. Whole digits are never replaced by zeros.
    """
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])  # after rounding: 9.996 has that of 10.0
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_interval(value: float, low: float | None, high: float | None, unit: str) -> str:
    """Format a quantity with four digits, and with its 95 % interval if it has one."""
    interval = "" if low is None or high is None else f"  (95 %: {significant(low, 4)} to {significant(high, 4)})"
    return f"{significant(value, 4)} {unit}{interval}"
