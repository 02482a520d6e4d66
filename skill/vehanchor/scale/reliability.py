"""Errors of each ruler: its spread, and how often it measures something else.

This module has the numbers of all rulers but the vehicles, each with its source and the number of
finds behind it. A measured chance of error is ``(false + 0.5) / (finds + 10)``. A number without
data is a choice, and its text states so. The numbers of vehicles belong to a detector, and are in a
file beside it (``vehanchor.detection.detector_errors``); the functions here take them as arguments.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.lengths import MIN_KDE_VEHICLES

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import ArrayLike, NDArray

    Factors: TypeAlias = NDArray[np.float64]
    """``[n]`` factors on standard deviations."""


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


KNOWN_REGION = 0.85
"""Share of the model's spread of reference lengths that remains within a region: with it, 95 of 100
intervals hold on the held-out tenth of the train split."""

PRIOR_POWER = 0.7
"""Exponent on the scene-scale prior, which counts inside the boxes' scores, too. With 1, 0.7 and
0.5, 556, 555 and 552 of 1,191 photographs are usable, 9, 8 and 9 of them wrong."""

MAX_CHANCE = 0.99
"""Largest chance: no estimate is certain. A choice."""

SAME_NUMBER = 0.02
"""Largest relative difference at which one number repeats another. A choice."""

_NOT_MEASURED = 0.05
"""Chance that a fact is wrong if its errors have not been counted. A choice."""

_MEASURED_WRONG = 0.02
"""Chance that one measured fact is wrong by itself, beside the chance that all measured facts of
its caller are; see MEASURING. With that chance it is ``_NOT_MEASURED``. A choice."""

_HEIGHT_WRONG = 0.04
"""Chance that a file's height is wrong, beside the chance that its lens is; with the usual lens it
is ``_NOT_MEASURED``. A choice."""

_ROUGH = 0.10
"""Standard deviation of the log scale by a guess. A choice."""

_EXACT = 0.01
"""Standard deviation of the log scale by tape, plan, survey or the rules of a game. A choice."""

RELIABILITY: dict[str, Reliability] = {
    "courts": Reliability(
        _EXACT, 0.08, n=8, source="1 of 8 finds in 1,006 random photographs is false; 30 known ones"
    ),
    "camera": Reliability(
        0.12,
        _HEIGHT_WRONG,
        n=0,
        source="height above take-off, 10 to 15 % between the ground there and below; a choice",
    ),
    "camera, tilt unknown": Reliability(_ROUGH, 0.25, n=0, source="a choice"),
    "positions": Reliability(
        0.02, _NOT_MEASURED, n=0, source="a choice; 31 pairs of photographs agree within 2 %"
    ),
    "measured": Reliability(
        _EXACT, _MEASURED_WRONG, n=0, source="a length by tape, plan or survey; a choice"
    ),
    "measured height": Reliability(0.05, _MEASURED_WRONG, n=0, source="a choice"),
    "assumed": Reliability(
        _ROUGH, _NOT_MEASURED, n=0, source="a length or height that the caller assumes; a choice"
    ),
}
"""Errors by ruler, and by its condition."""


def uncalibrated_wrong(n_likely: int) -> float:
    """Choose the chance that vehicles are wrong, for a detector without fitted votes.

    Each car below five adds the same chance.

    Args:
        n_likely: number of boxes that are likely cars.
    """
    n_lacking = max(0, MIN_KDE_VEHICLES - n_likely)
    return _NOT_MEASURED * (1 + n_lacking)


class CoarseErrors(NamedTuple):
    """Errors of vehicles that are too coarse for the resolution guard.

    Attributes:
        log_sd: standard deviation of the log of their scale.
        chance_wrong: 0..1, chance that they do not show the scale.
    """

    log_sd: float
    chance_wrong: float


def unresolved(
    coarseness: float, *, log_sd_per_log: float, chance_wrong_per_log: float
) -> CoarseErrors:
    """Compute the errors of vehicles that are too coarse for the resolution guard.

    Args:
        coarseness: ``P_thresh`` over the vehicles' length; up to 1 they are fine enough.
        log_sd_per_log: standard deviation per log of the coarseness.
        chance_wrong_per_log: chance that they are wrong per log of the coarseness.
    """
    log_coarseness = math.log(max(1.0, coarseness))
    log_sd = log_sd_per_log * log_coarseness
    chance_wrong = chance_wrong_per_log * log_coarseness
    return CoarseErrors(log_sd, min(1.0, chance_wrong))


def appearance_error(scores: ArrayLike, *, fair_odds: float, doubt_power: float) -> Factors:
    """Compute the factor on the errors of lengths by appearance that the network states.

    The factor is smaller, the more certain it is that a box is a car.

    Args:
        scores: ``[n]`` detection scores.
        fair_odds: odds of a car at which the factor is 1.
        doubt_power: power of the factor at other odds.

    Returns:
        ``[n]`` factors.
    """
    p_car = np.clip(scores, 1 - MAX_CHANCE, MAX_CHANCE)
    relative_odds = fair_odds * (1 - p_car) / p_car
    return np.asarray(relative_odds**doubt_power)


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
"""A caller misidentifies all things of exact size in an image, if they differ in kind. A choice."""

POINTING = Shared("caller", 0.0)
"""A caller who points at cars may be mistaken as with other guesses. Without other guesses it is no
further error."""

MEASURING = Shared("caller's measurements", 0.0, 0.03)
"""All measured facts of one caller are wrong together: one tape, one plan, one mistaken unit. A
choice."""

FILE = Shared("file", 0.0)
"""A guess has the error of what the file states: the caller has the file, and may have read the
guess off it. The ruler ``camera`` gives this error its size; without that ruler it is none."""

# 5 of 9 photographs whose proportions are doubted are stretched.
_DOUBTED = 0.5

NO_ONE_SCALE = Shared("stretched or tilted image", 0.0, _DOUBTED)
"""A stretched or tilted image has no single scale for any ruler. All 3 photographs whose cars are
larger on one side are tilted, and their scales are 1 to 24 % off."""

NO_CARS = Shared("look-alikes", 0.0)
"""Look-alikes are not cars: their own scale says nothing, nor does a prior that agrees with it. The
vehicles give this error its chance (``vehanchor.rulers.look_alikes``)."""
