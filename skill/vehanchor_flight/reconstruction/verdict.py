"""The size of a model in one sentence."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_OWN_UNITS = 1.5  # a factor beyond this, or below its inverse, means that the model is not in metres


def verdict(factor: Sequence[float] | None, *, usable: bool) -> str:
    """Put a factor in a sentence.

    Args:
        factor: metres per unit of the model, with the ends of its 95 % interval; None without one.
        usable: whether the confidence suffices.
    """
    if factor is None:
        return "The model shows nothing of known size: its size remains unknown."
    said = _size(*factor)
    return said if usable else f"Uncertain, do not use: {said[0].lower()}{said[1:]}"


def _size(factor: float, low: float, high: float) -> str:
    spread = f"+- {50 * (high - low) / factor:.2g} %"
    if not 1 / _OWN_UNITS <= factor <= _OWN_UNITS:
        return f"One unit of the model is {factor:.4g} m, {spread}."
    percent = 100 * (1 / factor - 1)  # the size that it has over the size that it should have
    off = f"{abs(percent):.1f} % too {'small' if percent < 0 else 'large'}, {spread}"
    return (
        f"The model has its size: {off}."
        if low <= 1 <= high
        else f"The model is {off}: multiply its lengths by {factor:.4g}."
    )
