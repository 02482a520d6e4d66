"""Vehicles of a scene: length, width, body and colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from research.scenes.truth import FleetKind, VehicleKind

# (mean length in m, standard deviation, share, bodies) before scaling to the requested mean.
# Mixture: mean 4.544 m,
# standard deviation 8.7 % of it, mode 1.010 x the mean.
_CLASSES: tuple[tuple[float, float, float, tuple[str, ...]], ...] = (
    (3.72, 0.13, 0.07, ("city",)),
    (4.18, 0.15, 0.20, ("hatchback", "hatchback", "city")),
    (4.55, 0.15, 0.38, ("hatchback", "sedan", "estate", "suv")),
    (4.80, 0.17, 0.24, ("sedan", "sedan", "estate", "suv")),
    (5.15, 0.18, 0.11, ("van", "pickup", "sedan", "van")),
)
# Cars of all continents and work vehicles: mean 4.58 m.
_MIXED_CLASSES: tuple[tuple[float, float, float, tuple[str, ...]], ...] = (
    (3.39, 0.02, 0.12, ("kei", "kei", "kei truck")),
    (3.80, 0.13, 0.12, ("city", "hatchback")),
    (4.25, 0.15, 0.18, ("hatchback", "sedan", "suv")),
    (4.65, 0.15, 0.22, ("sedan", "estate", "suv", "minivan")),
    (5.00, 0.17, 0.14, ("sedan", "van", "minivan", "suv", "single cab")),
    (5.45, 0.18, 0.14, ("single cab", "crew cab", "crew cab", "van", "flatbed")),
    (5.85, 0.12, 0.08, ("crew cab", "crew cab", "van")),
)
_FLEETS: dict[FleetKind, tuple[tuple[float, float, float, tuple[str, ...]], ...]] = {
    "passenger": _CLASSES,
    "mixed": _MIXED_CLASSES,
}
_MAX_DEVIATION = 2.5

_WIDTH_PER_LENGTH = 0.40
# Short cars are narrower, but less than in proportion.
_WIDTH_FOLLOWS_LENGTH = 0.55
_WIDTH_SD = 0.02

# Shares of paint as seen on European car parks: white, silver, grey, black, blue, red, green,
# beige, yellow/orange.
_PAINTS: tuple[tuple[float, tuple[int, int, int]], ...] = (
    (0.25, (232, 233, 232)),
    (0.17, (178, 181, 184)),
    (0.17, (112, 115, 119)),
    (0.20, (38, 39, 43)),
    (0.085, (48, 70, 118)),
    (0.07, (150, 32, 34)),
    (0.02, (52, 82, 62)),
    (0.025, (170, 155, 130)),
    (0.01, (205, 140, 40)),
)
_PAINT_CUMULATIVE = np.cumsum([share for share, _ in _PAINTS]) / sum(share for share, _ in _PAINTS)

# (body, length range in m, width range in m, paints)
_LARGE: tuple[tuple[str, tuple[float, float], tuple[float, float]], ...] = (
    ("truck", (7.0, 10.5), (2.35, 2.5)),
    ("bus", (10.5, 12.5), (2.5, 2.55)),
    ("semitrailer", (14.5, 16.5), (2.5, 2.55)),
    ("caravan", (6.0, 7.6), (2.2, 2.35)),
)


@dataclass(frozen=True)
class VehicleModel:
    """Vehicle before it is placed."""

    kind: VehicleKind
    body: str
    length_m: float
    width_m: float
    paint: tuple[int, int, int]


class Fleet:
    """Random source of vehicles; small ones have the given mean length."""

    def __init__(self, mean_length_m: float, rng: Generator, kind: FleetKind = "passenger") -> None:
        self.mean_length_m = mean_length_m
        self.kind = kind
        self._classes = _FLEETS[kind]
        shares = np.array([entry[2] for entry in self._classes])
        self._cumulative = np.cumsum(shares) / shares.sum()
        self._scale = mean_length_m / float(np.dot(shares, [entry[0] for entry in self._classes]))
        self._rng = rng

    @property
    def max_length_m(self) -> float:
        """Length of the longest small vehicle."""
        return (self._classes[-1][0] + _MAX_DEVIATION * self._classes[-1][1]) * self._scale

    @property
    def max_width_m(self) -> float:
        """Width of the widest small vehicle."""
        typical = (
            _WIDTH_FOLLOWS_LENGTH * self.max_length_m
            + (1 - _WIDTH_FOLLOWS_LENGTH) * self.mean_length_m
        )
        return _WIDTH_PER_LENGTH * typical * (1 + _WIDTH_SD * _MAX_DEVIATION)

    @property
    def bay_length_m(self) -> float:
        """Length of a parking bay that suits the fleet."""
        return max(5.0, 1.1 * self.mean_length_m)

    @property
    def bay_width_m(self) -> float:
        """Width of a parking bay that suits the fleet."""
        return max(2.5, 0.54 * self.mean_length_m)

    def small(self) -> VehicleModel:
        """Draw a car or van."""
        rng = self._rng
        mean, sd, _, bodies = self._classes[int(np.searchsorted(self._cumulative, rng.random()))]
        deviation = _bounded(rng)
        length = (mean + sd * deviation) * self._scale
        typical = _WIDTH_FOLLOWS_LENGTH * length + (1 - _WIDTH_FOLLOWS_LENGTH) * self.mean_length_m
        spread = 1 + _WIDTH_SD * _bounded(rng)
        body = bodies[rng.integers(len(bodies))]
        return VehicleModel(
            "small-vehicle",
            body,
            length_m=length,
            width_m=_WIDTH_PER_LENGTH * typical * spread,
            paint=self._paint(body),
        )

    def large(self, *bodies: str) -> VehicleModel:
        """Draw a truck, bus, articulated lorry or caravan, or one of the named bodies."""
        rng = self._rng
        choices = [entry for entry in _LARGE if not bodies or entry[0] in bodies]
        body, (shortest, longest), (narrowest, widest) = choices[rng.integers(len(choices))]
        length = rng.uniform(shortest, longest)
        width = rng.uniform(narrowest, widest)
        return VehicleModel(
            "large-vehicle",
            body,
            length_m=float(length),
            width_m=float(width),
            paint=self._paint(body),
        )

    def _paint(self, body: str) -> tuple[int, int, int]:
        rng = self._rng
        index = int(np.searchsorted(_PAINT_CUMULATIVE, rng.random()))
        if (body in ("van", "caravan") and rng.random() < 0.75) or (
            body in ("truck", "semitrailer") and rng.random() < 0.5
        ):
            index = 0
        if body == "bus" and rng.random() < 0.6:
            index = int(rng.choice([0, 4, 5, 6]))
        gain = rng.normal(1, 0.08)
        tint = rng.normal(0, 3, 3).tolist()
        red, green, blue = (
            int(min(max(c * gain + t, 14), 246))
            for c, t in zip(_PAINTS[index][1], tint, strict=True)
        )
        return red, green, blue


def _bounded(rng: Generator) -> float:
    return min(max(float(rng.standard_normal()), -_MAX_DEVIATION), _MAX_DEVIATION)
