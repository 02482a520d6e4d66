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

from vehanchor.odds import chance_of
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

PRIOR_POWER = 0.8
"""Exponent on the scene-scale prior, which counts inside the boxes' scores, too. With 0.7, 0.8,
0.85 and 0.9, 91, 99, 99 and 102 of 198 photographs near the limit are usable, 3, 2, 2 and 2 of them
wrong; before the prior had the error of the place, it was 99 and 2 with 0.7. On 1,191 photographs,
1, 0.7 and 0.5 gave 556, 555 and 552, 9, 8 and 9 of them wrong. A choice among these."""

MAX_CHANCE = 0.99
"""Largest chance: no estimate is certain. A choice."""

SAME_NUMBER = 0.02
"""Largest relative difference at which one number repeats another. A choice."""

_MIN_SCATTERED = 3
"""Vehicles from which their scatter counts. A choice."""

_NOT_MEASURED = 0.05
"""Chance that a fact is wrong if its errors have not been counted. A choice."""

_MEASURED_WRONG = 0.02
"""Chance that one measured fact is wrong by itself, beside the chance that all measured facts of
its caller are; see MEASURING. With the mistakes of any size it is ``_NOT_MEASURED``. A choice."""

_HEIGHT_WRONG = 0.005
"""Chance that a file's height says nothing, beside the chances of a hill and of a wrong lens. A
choice."""

LEVEL_SD_M = 3.0
"""Standard deviation, in metres, of a height above take-off as one above level ground: barometer,
take-off from a hand or a roof, and ground that is level within some metres. A choice."""

HILL_CHANCE = 0.25
"""Chance that the ground below the camera is not level with the take-off, which was on a hill or in
a valley, or that the height is stale. A choice on the safe side: with it, a height alone has a
chance of 0.82. It is usable where the scene-scale prior clearly prefers it to its double and its
half, and not where the prior does not tell them apart, as over fields.

Without a car in sight, and with each place left out of the prior's training, 70 of 146 photographs
of towns are usable at the true height, 28 of 292 at 1.5 times or two thirds of it, and 3 of 292 at
double or half; of 329 crops of fields and other ground 40, 12 of 658 and 6 of 658. With a chance
of 0.2 it is 103, 73 and 15, and 120, 84 and 52; with 0.14 140, 163 and 66, and 281, 458 and 270.
Nothing tells these heights apart better: the prior's ratio to the double and the half alone, its
tails, its powers from 0.3 to 1, a wider or a finer prior, and hills of 0.35 to 0.8 leave at most as
many right ones at as many wrong ones.

The ground is level in both flights at hand whose scale is known without the height: positions of 31
pairs of ``chia`` agree within 2 %, and the cars of ``tilt`` within their error."""

HILL_LOG_SD = 0.45
"""Standard deviation of the log of the height above take-off over that above the ground, on a hill:
from half to double the height. A choice."""

ROOF_CHANCE = 0.25
"""Chance that a laser range finder, which measures in the middle of the image, meets a roof, a tree
or a pit and not the ground. A choice: about the share of roofs and trees in towns."""

ROOF_SD_M = 10.0
"""Standard deviation, in metres, of a height by a laser that does not meet the ground. A choice:
three storeys. With it, a height of 50 m and more is usable by itself."""

_ROUGH = 0.10
"""Standard deviation of the log scale by a guess. A choice."""

_HALF_ROUGH = _ROUGH / math.sqrt(2)
"""Half of that variance is the error of one guess, and half is shared; see ROUGH. A choice."""

_EXACT = 0.01
"""Standard deviation of the log scale by tape, plan, survey or the rules of a game. A choice."""

RELIABILITY: dict[str, Reliability] = {
    "courts": Reliability(
        _EXACT,
        0.03,
        n=7,
        source="0 of 7 finds that fit well, in 1,006 random photographs, is false; 30 known ones",
    ),
    "camera": Reliability(
        0.04,
        _HEIGHT_WRONG,
        n=0,
        source="height above take-off over level ground, beside LEVEL_SD_M; a choice",
    ),
    "camera, tilt unknown": Reliability(_ROUGH, 0.25, n=0, source="a choice"),
    "laser": Reliability(
        0.005,
        _HEIGHT_WRONG,
        n=0,
        source="DJI states 0.2 m and 0.15 % for Matrice 30 and 4; beside LEVEL_SD_M and ROOF_SD_M",
    ),
    "positions": Reliability(
        0.02, _NOT_MEASURED, n=0, source="a choice; 31 pairs of photographs agree within 2 %"
    ),
    "measured": Reliability(
        _EXACT, _MEASURED_WRONG, n=0, source="a length by tape, plan or survey; a choice"
    ),
    "measured height": Reliability(0.05, _MEASURED_WRONG, n=0, source="a choice"),
    "assumed": Reliability(
        _HALF_ROUGH,
        _NOT_MEASURED,
        n=0,
        source="a length or height that the caller assumes, beside ROUGH; a choice",
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


def excess_scatter(log_scales: ArrayLike, log_sds: ArrayLike, *, usual_n: float) -> float:
    """Compute how far measurements scatter beyond what their errors state.

    It is the Birge ratio (R. T. Birge, "The calculation of errors by the method of least squares",
    Physical Review 40, 1932), as if ``usual_n`` more measurements scattered as stated. Its lower
    limit is 1: alike vehicles with one and the same error agree, too.

    Args:
        log_scales: ``[n]`` logs of the scale by each vehicle.
        log_sds: ``[n]`` their standard deviations.
        usual_n: number of measurements that stand for the usual scatter.

    Returns:
        Factor on standard deviations, at least 1; 1 for fewer than three vehicles.
    """
    values = np.asarray(log_scales, dtype=np.float64)
    if len(values) < _MIN_SCATTERED:
        return 1.0
    weights = np.asarray(log_sds, dtype=np.float64) ** -2
    mean = np.average(values, weights=weights)
    chi_squared = np.sum(weights * (values - mean) ** 2)
    ratio_squared = (usual_n + chi_squared) / (usual_n + len(values) - 1)
    return math.sqrt(max(1.0, ratio_squared))


class Shared(NamedTuple):
    """Error that several witnesses have in common.

    Attributes:
        name: name of its cause; witnesses that name the same cause have the same error.
        log_sd: standard deviation of the log scale.
        chance_wrong: 0..1, chance that the cause makes all of them wrong.
        chance_large: 0..1, chance that the error is not of the usual size, but large.
        large_log_sd: standard deviation of the log scale if it is large.
        near_share: 0..1, share of ``chance_wrong`` in which the scale is near what the witnesses
            give, although they are wrong; in the rest all scales are equally likely.
        near_log_sd: standard deviation of the log scale if it is near.
    """

    name: str
    log_sd: float
    chance_wrong: float = 0.0
    chance_large: float = 0.0
    large_log_sd: float = 0.0
    near_share: float = 0.0
    near_log_sd: float = 0.0


MISFIT = Shared("court", 0.0, near_share=1 / 3, near_log_sd=0.2)
"""What looks like a court is none. Such a fit is often near the scale, because the search adapts
the lines to it. A choice by the one false find: lanes of a freeway, 10 % off, moved the scale of
nine right cars by 9 %, and move it by 2 %. All 72 right answers with a court stay usable; with a
share of 1 and 0.56, as if all scales of the search were equally likely, four are lost."""


def court_misfit(quality: float) -> Shared:
    """Compute the error that a find is not a court, by how well its lines fit.

    The odds were fitted to 305 fits, most of them too poor to be finds, in 1,905 photographs of
    known scale: 173 are right within 4 %. They hold where courts are as rare as in the photographs
    that were not chosen for them, with 10 false fits for each court. Of 162 true finds the median
    is 0.04; the false one, which its surplus lines exclude now, had 0.86 with the chance in
    RELIABILITY.

    Args:
        quality: ``Court.quality``.
    """
    log_odds = 9.2 - 18.0 * quality
    return MISFIT._replace(chance_wrong=chance_of(log_odds))


CALLER = Shared("caller", 0.0, 0.11)
"""All guesses of one caller are wrong together; with a guess's own chance, 0.15. A choice."""

ROUGH = Shared("caller's sense of size", _HALF_ROUGH)
"""A caller who takes one thing for too large takes others for too large, too. A choice."""

RECOGNITION = Shared("caller", 0.0, _NOT_MEASURED)
"""A caller misidentifies all things of exact size in an image, if they differ in kind. A choice."""

POINTING = Shared("caller", 0.0)
"""A caller who points at cars may be mistaken as with other guesses. Without other guesses it is no
further error."""

MEASURING = Shared("caller's measurements", 0.0, 0.045, near_share=1 / 3, near_log_sd=0.5)
"""All measured facts of one caller are wrong together: one tape, one plan, one mistaken unit. A
choice. So is the share of mistakes that are near: who measures a wrong thing usually measures one
from half to double the size, not one of any size. Without that share, a line 1.5 times off was
wrong and `ok` in 51 of 200 cases against one to four cars, in 10 of them against cars that are `ok`
by themselves; with it in 31 and 3. The right line leads in 96 of 100 with both. The share was
chosen on some of the same photographs."""

CONTRADICTION_POWER = 2.0
"""Power of the share of what is seen that excludes a scale, in the ceiling that this sets to the
chance of stated facts. Against one to four cars of 160 photographs outside val, 70 of 320 measured
lines that were 1.5 times off were usable and wrong without a ceiling; 46, 37, 30 and 20 with powers
of 4, 3, 2 and 1. Of lines that were 1.3 times off it was 81 of 160, and 52, 36, 23 and 14; of 160
right lines 156 were usable, and 155, 154, 150 and 124. In val, 26 of 110 become 9 with a power of
2, and 53 of 55 right lines 52. Against most of the rest, cars say next to nothing. A larger chance
in MEASURING, 0.07 with half of it near, leaves as many wrong ones. A choice among these."""

GEOREFERENCE_LOG_SD = 0.01
"""Error of a georeference that is right: the grid scale of projections, relief in orthophotos. A
choice."""

FILE = Shared("file", 0.0)
"""A guess has the error of what the file states: the caller has the file, and may have read the
guess off it. The ruler ``camera`` gives this error its size; without that ruler it is none."""

# 5 of 9 photographs whose proportions are doubted are stretched.
_DOUBTED = 0.5

NO_ONE_SCALE = Shared("stretched or tilted image", 0.0, _DOUBTED)
"""A stretched or tilted image has no single scale for any ruler. All 3 photographs whose cars are
larger on one side are tilted, and their scales are 1 to 24 % off."""

STRETCHED_SHARE = 0.004
"""Share of images that are stretched by a quarter or more without a word in the file. A choice: of
1,081 photographs stretched by 1.25 to 1.6, 517 would be usable and more than 20 % off along one
axis; 181 are with the networks' verdicts alone, 71 were with the odds by the vehicles' look, and 40
are with those by the detail along rows and columns, too. Of 1,050 right scales 6 are lost instead
of 11. With shares of 0.003 and 0.005 it is 43 and 40. A third of the photographs, on which nothing
was fitted, agree: 19 of 70 are left, where 33 were."""


def chance_of_stretch(log_odds: float) -> float:
    """Compute the chance that an image is stretched, by the log odds of its vehicles' look."""
    odds = STRETCHED_SHARE / (1 - STRETCHED_SHARE) * math.exp(log_odds)
    return odds / (1 + odds)


class ProportionLikelihoods(NamedTuple):
    """How likely a finding is in images of different proportions.

    Attributes:
        true: density in an image of true proportions.
        too_wide: density in one whose width was stretched, or whose height was compressed.
        too_high: density in one whose height was stretched, or whose width was compressed.
    """

    true: float
    too_wide: float
    too_high: float


NO_DETAIL = ProportionLikelihoods(1.0, 1.0, 1.0)
"""Likelihoods of an image whose detail says nothing about its proportions."""

# Differences of detail of 1,905 photographs, and of as many that were stretched by 1.25 to 1.6 in
# one direction by four kinds of interpolation and then often compressed; the mean shift is 1.5 for
# enlarged ones, and 0.5 to 1 for reduced ones. In a third of the photographs something else differs
# by direction: 52 photographs by one drone have 1.2, as if its motion had blurred them.
_DETAIL_SD = 0.25
_DETAIL_OUTLIERS = 0.33
_DETAIL_OUTLIER_SD = 0.75
_DETAIL_SHIFT = 1.2
_DETAIL_SHIFT_SD = 0.7


def detail_likelihoods(difference: float | None) -> ProportionLikelihoods:
    """Compute how likely a difference of detail is in images of different proportions.

    Args:
        difference: see ``vehanchor.imagery.axis_detail``; None if it is unknown.
    """
    if difference is None:
        return NO_DETAIL
    usual = (1 - _DETAIL_OUTLIERS) * normal_density(difference, _DETAIL_SD)
    outlying = _DETAIL_OUTLIERS * normal_density(difference, _DETAIL_OUTLIER_SD)
    return ProportionLikelihoods(
        usual + outlying,
        too_wide=normal_density(difference + _DETAIL_SHIFT, _DETAIL_SHIFT_SD),
        too_high=normal_density(difference - _DETAIL_SHIFT, _DETAIL_SHIFT_SD),
    )


SD_PER_MEDIAN_DEVIATION = 1.48
"""Standard deviation of a normal distribution over its median deviation."""


def normal_density(deviation: float, sd: float) -> float:
    """Compute the density of a normal distribution around zero."""
    norm = sd * math.sqrt(2 * math.pi)
    return math.exp(-0.5 * (deviation / sd) ** 2) / norm


UPRIGHT_SHARE = 0.01
"""Share of photographs of unknown tilt that a camera on a pole took, for which the sizes of their
cars must speak. A choice: of 77 rendered views from poles 17 were `ok`, 8 of them wrong; 4 of these
remain, and 1 of 1,061 right scales of photographs at nadir is lost. With 0.015, and boxes from a
score of 0.5 on, 3 remain, and 5 are lost. The proportions of boxes tell less: those of 1 of 6 are
beyond 99 of 100 at nadir."""


def chance_of_tilt(log_odds: float) -> float:
    """Compute the chance that the camera looks ahead, by the log odds of its cars' sizes.

    What the sizes leave open is in the other chances: only odds above even ones count.
    """
    excess = math.expm1(min(max(log_odds, 0.0), _MAX_LOG_ODDS))
    odds = UPRIGHT_SHARE / (1 - UPRIGHT_SHARE) * excess
    return odds / (1 + odds)


# Limit of log odds, beyond which nothing changes.
_MAX_LOG_ODDS = 50.0

_OBLONG_DENSITY = 1.1
_STRETCHED_SHARE_BY_DENSITY = 0.1


def log_odds_by_density(aspect: float) -> float:
    """Compute the log odds of a stretch that a header's density adds; 0 if its pixels are square.

    Programs often write a wrong density, so that one stretched image in ten is a choice.

    Args:
        aspect: height of a pixel over its width by the density.
    """
    if max(aspect, 1 / aspect) < _OBLONG_DENSITY:
        return 0.0
    hinted = _STRETCHED_SHARE_BY_DENSITY / (1 - _STRETCHED_SHARE_BY_DENSITY)
    usual = STRETCHED_SHARE / (1 - STRETCHED_SHARE)
    return math.log(hinted / usual)


NO_CARS = Shared("look-alikes", 0.0)
"""Look-alikes are not cars: their own scale says nothing, nor does a prior that agrees with it. The
vehicles give this error its chance (``vehanchor.rulers.look_alikes``)."""
