"""Errors of each ruler: its spread, and how often it measures something else.

All such numbers stand here, each with the number of finds behind it and its source. A measured
chance of error is ``(false + 0.5) / (finds + 10)``. A number without data is a choice, and says so.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.lengths import MIN_KDE_VEHICLES

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


class Reliability(NamedTuple):
    """Errors of one ruler.

    Attributes:
        log_sd: standard deviation of the log of its scale.
        chance_wrong: 0..1, chance that it measured something else.
        n: number of finds behind both numbers; 0 for a choice.
        source: source of the numbers.
    """

    log_sd: float
    chance_wrong: float
    n: int
    source: str


_PLACES = "photographs of 30 places that no network has learned from, November 2026"

CAR_LOG_SD = 0.12
"""Standard deviation of the log length of one car's box around its fleet, if its appearance is not
used; 0.10 to 0.145 by place."""

APPEARANCE_LOG_SD = 0.055
"""Standard deviation, between places, of the log of a fleet's length by its appearance: 0.047
between 13 places, of which the network has learned from six."""

APPEARANCE_LOG_MEAN = -0.015
"""Mean error of that log. Cars of 13 places are 2.8 % shorter than they look; half of it is taken
off. Any mean of -0.03 to 0 and spread of 0.04 to 0.06 makes 1,089 to 1,099 of 1,255 photographs
usable, 8 to 11 of them wrong; with a spread below 0.05 fewer than 95 of 100 intervals hold."""

_FAIR_ODDS = 20.0
_DOUBT_POWER = 0.125
"""Odds of a car at which its appearance errs as stated, and the power of the error at other odds.
Of 15,060 vehicles in photographs of known scale the rms error is 0.89 of the stated one for scores
from 0.995 on, and 1.3 below 0.95."""

KNOWN_REGION = 0.85
"""Share of the model's spread of reference lengths that remains within a region: with it, 95 of 100
intervals hold on the held-out tenth of the train split."""

PRIOR_POWER = 0.7
"""Exponent on the scene-scale prior, which counts inside the boxes' scores, too. With 1, 0.7 and
0.5, 556, 555 and 552 of 1,191 photographs are usable, 9, 8 and 9 of them wrong."""

MAX_CHANCE = 0.99
"""Largest chance: no estimate is certain. A choice."""

SAME_NUMBER = 0.02
"""Largest relative difference of two numbers of which one repeats the other. A choice."""

_NOT_MEASURED = 0.05
"""Chance that a fact is wrong if nobody has counted its errors. A choice."""

_ROUGH = 0.10
_EXACT = 0.01
"""Standard deviations of the log scale by a guess, and by tape, plan, survey or rule. Choices."""

RELIABILITY: dict[str, Reliability] = {
    "vehicles": Reliability(CAR_LOG_SD, 0.01, n=1191, source=_PLACES),
    "vehicles, too coarse": Reliability(
        0.5, 0.33, n=136, source="per log of coarseness; 70 photographs at 0.3 to 0.6 m/px"
    ),
    "courts": Reliability(
        _EXACT, 0.08, n=8, source="1 of 8 finds in 1,006 random photographs is false; 30 known ones"
    ),
    "camera": Reliability(
        0.12,
        _NOT_MEASURED,
        n=0,
        source="height above take-off, 10 to 15 % between the ground there and below; a choice",
    ),
    "camera, tilt unknown": Reliability(_ROUGH, 0.25, n=0, source="a choice"),
    "positions": Reliability(
        0.02, _NOT_MEASURED, n=0, source="a choice; 31 pairs of photographs agree within 2 %"
    ),
    "measured": Reliability(
        _EXACT, _NOT_MEASURED, n=0, source="a length by tape, plan or survey; a choice"
    ),
    "measured height": Reliability(0.05, _NOT_MEASURED, n=0, source="a choice"),
    "assumed": Reliability(
        _ROUGH, _NOT_MEASURED, n=0, source="a length or height that the caller assumes; a choice"
    ),
}
"""Errors by ruler, and by its condition."""


def uncalibrated_wrong(n_likely: int) -> float:
    """Choose the chance that vehicles are wrong, for a detector without fitted votes.

    Args:
        n_likely: number of boxes that are likely cars. Each car below five adds the same chance.
    """
    n_lacking = max(0, MIN_KDE_VEHICLES - n_likely)
    return _NOT_MEASURED * (1 + n_lacking)


def unresolved(coarseness: float) -> Reliability:
    """Return the errors of vehicles that are too coarse for the resolution guard.

    Args:
        coarseness: ``P_thresh`` over the vehicles' length; up to 1 they are fine enough.
    """
    per_log = RELIABILITY["vehicles, too coarse"]
    log_coarseness = math.log(max(1.0, coarseness))
    log_sd = per_log.log_sd * log_coarseness
    chance_wrong = per_log.chance_wrong * log_coarseness
    return per_log._replace(log_sd=log_sd, chance_wrong=min(1.0, chance_wrong))


def appearance_error(scores: ArrayLike) -> NDArray[np.float64]:
    """Compute the factor on the errors of lengths by appearance that the network states.

    The factor is smaller, the more certain it is that a box is a car.

    Args:
        scores: ``[n]`` detection scores.

    Returns:
        ``[n]`` factors; 1 at odds of a car of 20.
    """
    p_car = np.clip(scores, 1 - MAX_CHANCE, MAX_CHANCE)
    return np.asarray((_FAIR_ODDS * (1 - p_car) / p_car) ** _DOUBT_POWER)


class Shared(NamedTuple):
    """Error that several witnesses have in common.

    Attributes:
        name: name of its cause; witnesses that name the same cause have the same error.
        log_sd: standard deviation of the log scale.
        chance_wrong: 0..1, chance that the cause makes all of them wrong.
    """

    name: str
    log_sd: float
    chance_wrong: float = 0.0


CALLER = Shared("caller", 0.0, 0.11)
"""All guesses of one caller are wrong together; with a guess's own chance, 0.15. A choice."""

RECOGNITION = Shared("caller", 0.0, _NOT_MEASURED)
"""A caller misidentifies all things of known size in an image. A choice."""

# 5 of 9 photographs whose proportions are doubted are stretched.
_DOUBTED = 0.5

NO_ONE_SCALE = Shared("stretched or tilted image", 0.0, _DOUBTED)
"""A stretched or tilted image has no single scale for any ruler. All 3 photographs whose cars are
larger on one side are tilted, and their scales are 1 to 24 % off."""

NO_CARS = Shared("look-alikes", 0.0, _DOUBTED)
"""Look-alikes are not cars: their own scale says nothing, nor does a prior that agrees with it. One
of 204 fleets is taken for look-alikes."""
