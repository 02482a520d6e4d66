"""Loads in open beds and on roof racks."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from research.scenes.truth import Load

LOADS: tuple[Load, ...] = get_args(Load)
_BED_HALF_WIDTH = 0.80  # shares of the vehicle's half width
_RACK_HALF_WIDTH = 0.62


def add_load(
    sprite: NDArray[np.float32],
    load: str,
    along: NDArray[np.floating[Any]],
    across: NDArray[np.floating[Any]],
    span: tuple[float, float],
) -> None:
    """Draw a load into a sprite, in place.

    Args:
        sprite: ``[rows, columns, 4]``, see ``sprites``.
        load: one of ``LOADS``, a space, and the seed of its arrangement: ``crates 3``.
        along: ``[rows, columns]`` share of the length, from the front.
        across: ``[rows, columns]`` share of the half width, -1..1.
        span: front and rear end of the bed or rack, shares of the length.
    """
    name, _, seed = load.partition(" ")
    rng = np.random.default_rng(int(seed or 0))
    if name == "empty":
        _fill(sprite, _inside(along, across, span, _BED_HALF_WIDTH), float(rng.uniform(30, 170)))
    elif name == "tarpaulin":
        _fill(sprite, _inside(along, across, span, 0.9), float(rng.uniform(25, 190)))
    elif name == "rack":
        _draw_rack(sprite, rng, along, across, span)
    elif name == "planks":
        count = int(rng.integers(4, 9))
        stripes = 0.75 + 0.25 * np.sign(np.sin(across * np.pi * count))
        _fill(sprite, _inside(along, across, span, _BED_HALF_WIDTH * 0.9), float(rng.uniform(110, 200)) * stripes)
    else:
        _draw_crates(sprite, rng, along, across, span)


def _inside(
    along: NDArray[np.floating[Any]],
    across: NDArray[np.floating[Any]],
    span: tuple[float, float],
    half_width: float,
    middle: float = 0.0,
) -> NDArray[np.bool_]:
    return np.asarray((along > span[0]) & (along < span[1]) & (np.abs(across - middle) < half_width))


def _fill(sprite: NDArray[np.float32], where: NDArray[np.bool_], grey: float | NDArray[np.floating[Any]]) -> None:
    """Replace the paint by grey; keep the coverage."""
    level = np.broadcast_to(np.asarray(grey, np.float32), where.shape)
    sprite[where, 1] = 0
    sprite[where, 2] = level[where] * sprite[where, 0]
    sprite[where, 3] = 0


def _draw_rack(
    sprite: NDArray[np.float32],
    rng: np.random.Generator,
    along: NDArray[np.floating[Any]],
    across: NDArray[np.floating[Any]],
    span: tuple[float, float],
) -> None:
    """Draw bars across the roof, sometimes with a box or a ladder."""
    grey = float(rng.choice((20.0, 175.0)))
    for bar in np.linspace(span[0] + 0.04, span[1] - 0.06, int(rng.integers(2, 5))):
        _fill(sprite, _inside(along, across, (float(bar), float(bar) + 0.018), _RACK_HALF_WIDTH), grey)
    if rng.random() < 0.5:
        start, middle = rng.uniform(*span) * 0.5 + span[0] * 0.5, rng.uniform(-0.25, 0.25)
        _fill(sprite, _inside(along, across, (float(start), span[1]), 0.22, float(middle)), float(rng.uniform(20, 200)))


def _draw_crates(
    sprite: NDArray[np.float32],
    rng: np.random.Generator,
    along: NDArray[np.floating[Any]],
    across: NDArray[np.floating[Any]],
    span: tuple[float, float],
) -> None:
    """Draw three to nine grey objects, some reddish."""
    _fill(sprite, _inside(along, across, span, _BED_HALF_WIDTH), float(rng.uniform(25, 120)))
    for _ in range(int(rng.integers(3, 10))):
        start, size = float(rng.uniform(*span)), rng.uniform(0.04, 0.16)
        middle, half_width = float(rng.uniform(-0.55, 0.55)), float(rng.uniform(0.1, 0.35))
        where = _inside(along, across, (start, float(min(start + size, span[1]))), half_width, middle)
        _fill(sprite, where & (np.abs(across) < _BED_HALF_WIDTH), float(rng.uniform(15, 215)))
        if rng.random() < 0.25:
            sprite[where, 3] = 60 * sprite[where, 0]
