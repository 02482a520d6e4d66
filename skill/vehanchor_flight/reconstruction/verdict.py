"""The size of a model in one sentence."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

_OWN_UNITS = 1.5  # a factor beyond this, or below its inverse, means that the model is not in metres


def verdict(noun: str, factor: Sequence[float] | None, *, usable: bool, pixel: Sequence[float] | None = None) -> str:
    """Put a factor in a sentence.

    Args:
        noun: model or orthophoto.
        factor: metres per unit of the model, with the ends of its 95 % interval; None without one.
        usable: whether the confidence suffices.
        pixel: metres per pixel of an orthophoto, with the ends of its interval; None without any.
    """
    if factor is None and pixel is None:
        return f"The {noun} shows nothing of known size: its size remains unknown."
    said = _size(noun, *factor) if factor is not None else _pixel(*pixel or ())
    return said if usable else f"Uncertain, do not use: {said[0].lower()}{said[1:]}"


def _size(noun: str, factor: float, low: float, high: float) -> str:
    spread = f"+- {50 * (high - low) / factor:.2g} %"
    if not 1 / _OWN_UNITS <= factor <= _OWN_UNITS:
        return f"One unit of the {noun} is {factor:.4g} m, {spread}."
    if low <= 1 <= high:
        return f"The {noun} has its size: {_percent(factor)}, {spread}."
    return f"The {noun} is {_percent(factor)}, {spread}: multiply its lengths by {factor:.4g}."


def _percent(factor: float) -> str:
    percent = 100 * (1 / factor - 1)  # the size that it has over the size that it should have
    return f"{abs(percent):.1f} % too {'small' if percent < 0 else 'large'}"


def _pixel(gsd: float, low: float, high: float) -> str:
    return f"A pixel of the orthophoto is {gsd:.4g} m, +- {50 * (high - low) / gsd:.2g} %; its file states no scale."
