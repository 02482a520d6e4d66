"""Chance that vehicles are equal things that are not cars, such as graves, boats or carts in rows.

Cars of one image differ in length, in appearance and in paint; things of one model hardly do. The
evidence is a likelihood ratio for each of the three: how probable the measured spread is for n
equal things, over how probable it is for n cars. Few vehicles can be alike by chance, so that they
give little evidence; four cars of one model are possible.

More signs do not ask for equal things. Look-alikes look less like cars, by the chip network. Boxes
around a low thing and its shadow are longer along the shadow, whereas the length of a car does not
depend on its direction; and they all have the shadow's tone at one end. Karts and carts are wider
for their length than cars. The network also tells things from cars, one by one; the chance that all
are things is one more doubt beside the others.

There is no limit anywhere: the chance is a smooth function of all measurements.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.detections import thing_chances
from vehanchor.odds import chance_of
from vehanchor.scale.reliability import SD_PER_MEDIAN_DEVIATION, normal_density

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Appearance
    from vehanchor.detection.detector_errors import (
        DetectorErrors,
        EndErrors,
        HeadingErrors,
        LookAlikeErrors,
        ProportionErrors,
        SpreadErrors,
    )

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    Values: TypeAlias = NDArray[np.float64]
    """``[n]`` or ``[n, 3]`` measurements of vehicles."""

    EndTones: TypeAlias = NDArray[np.float64]
    """``[n, 2, 3]`` colours near both ends in CIELAB."""

# Standard normal deviates at which the distribution of a spread is integrated, and their weights.
_DEVIATES = np.linspace(-3.0, 3.0, 25)
_DEVIATE_WEIGHTS = np.exp(-(_DEVIATES**2) / 2)
# Number of vehicles that no larger number exceeds as evidence by itself. A choice.
_SATURATION = 20.0
# Mean lightness, 0 to 255, at which paints count half, and the width of the transition: in deep
# shadow they are alike. Of 781 fleets in photographs the one below 50 has a spread of 6, the two of
# 50 to 65 have 10 and 35, and nine of 65 to 80 a median of 42, as brighter ones. Rendered scenes of
# equal things begin at 62. A choice.
_EVEN_LIGHTNESS = 52.0
_LIGHTNESS_WIDTH = 3.0
# Fewest vehicles whose lengths can show a trend over their directions, or whose ends are compared.
_MIN_OF_TREND = 3
# Spread of one colour by noise and compression, in CIELAB from 0 to 255. A choice.
_TONE_NOISE = 2.0
# Things of one picture are of one kind: many doubtful ones tell more than each by itself. The log
# odds that all are things are the mean of theirs, which rises with the log of their number. Of
# photographs, those with many vehicles have the lowest means. Choices, in view of 160 scenes.
_ODDS_PER_LOG_N = 2.5
_ALL_THINGS_ODDS = -0.3
# Number of vehicles that no larger number exceeds here. A choice: with 20, car parks with a hundred
# cars lose theirs.
_THINGS_SATURATION = 10.0
# Log odds of one vehicle count within these limits. A choice.
_ODDS_LIMITS = (-11.5, 4.5)
# Largest absolute log odds: no doubt is certain, and none is excluded.
_MAX_LOG_ODDS = 20.0


def chance_of_look_alikes(
    boxes: Boxes,
    appearance: Appearance | None,
    detector_errors: DetectorErrors,
    *,
    undistorted: bool,
) -> float:
    """Compute the chance, 0..1, that vehicles are look-alikes.

    Args:
        boxes: ``[n, 5]`` the vehicles, those with an appearance first.
        appearance: appearance of the vehicles that have any; None without a chip network.
        detector_errors: the detector's errors.
        undistorted: whether the vehicles have lengths, proportions and looks of their own. Those
            of a stretched image, and those of a tilted view, whose boxes were rectified, depend on
            their directions.
    """
    errors = detector_errors.look_alikes
    log_lengths = np.log(boxes[:, 2])
    log_odds = errors.log_odds
    evidence = spread_evidence(log_lengths, errors.lengths)
    if undistorted:
        evidence += heading_evidence(log_lengths, boxes[:, 4], errors.headings)
    if appearance is not None:
        evidence += spread_evidence(appearance.log_lengths, errors.appearance)
        if undistorted:
            bodies = boxes[: len(appearance)]
            usual = detector_errors.appearance.length_over_width
            evidence += proportion_evidence(bodies, errors.proportions, usual)
        log_odds += _logit_evidence(appearance.logits, errors)
        if appearance.end_tones is not None:
            headings = boxes[: len(appearance), 4]
            evidence += end_evidence(appearance.end_tones, headings, errors.ends)
        if appearance.tones is not None:
            light = _light_share(appearance.tones)
            evidence += light * spread_evidence(appearance.tones, errors.tones)
            # Only if all three spreads are known, their evidence for cars balances this rise.
            number = _log_telling_number(len(boxes), _SATURATION)
            rise = errors.log_odds_per_log_n * number
            log_odds += light * rise
    log_odds += errors.spread_power * evidence
    bounded = min(max(log_odds, -_MAX_LOG_ODDS), _MAX_LOG_ODDS)
    chance = chance_of(bounded)
    # Cars of other proportions look like other things.
    if undistorted and appearance is not None and appearance.thing_log_odds is not None:
        p_things = chance_of_things(appearance.thing_log_odds, len(boxes))
        chance = 1.0 - (1.0 - chance) * (1.0 - p_things)
    return chance


def chance_of_things(log_odds: Values, n: int) -> float:
    """Compute the chance, 0..1, that all vehicles are things by the looks of each.

    Args:
        log_odds: log odds of each examined vehicle to be a thing.
        n: number of all vehicles.
    """
    if len(log_odds) == 0:
        return 0.0
    mean = float(np.clip(log_odds, *_ODDS_LIMITS).mean())
    rise = _ODDS_PER_LOG_N * _log_telling_number(n, _THINGS_SATURATION)
    return float(thing_chances(np.array(mean + rise + _ALL_THINGS_ODDS)))


def _light_share(tones: Values) -> float:
    """Compute how much paints ``[n, 3]`` tell, 0 to 1: little in deep shadow."""
    surplus = float(np.mean(tones[:, 0])) - _EVEN_LIGHTNESS
    return chance_of(surplus / _LIGHTNESS_WIDTH)


def _log_telling_number(n: int, saturation: float) -> float:
    """Compute the log of the number of vehicles, which saturates smoothly."""
    return math.log(n / (1.0 + (n - 1) / saturation))


def spread_evidence(values: Values, errors: SpreadErrors) -> float:
    """Compute the log likelihood ratio of equal things over cars from the spread of a measurement.

    Args:
        values: ``[n]`` measurements, or ``[n, 3]`` colours; a single vehicle has no spread.
        errors: usual spreads of cars and of equal things.
    """
    n_free = len(values) - 1
    if n_free < 1:
        return 0.0
    # The colours of vehicles differ mainly in brightness: their three axes count as one.
    per_axis = np.var(values, axis=0, ddof=1)
    variance = float(np.sum(per_axis))
    of_things = _log_likelihood(variance, n_free, errors.things, errors.things_log_sd)
    of_cars = _log_likelihood(variance, n_free, errors.cars, errors.cars_log_sd)
    return of_things - of_cars


def _log_likelihood(variance: float, n_free: int, typical: float, log_sd: float) -> float:
    """Compute the log likelihood of a sample variance, up to a constant.

    The true spread is not known: its log is normal.

    Args:
        variance: sample variance.
        n_free: its degrees of freedom.
        typical: median of the true spread.
        log_sd: standard deviation of the log of the true spread.
    """
    log_spreads = math.log(typical) + log_sd * _DEVIATES
    variances = np.exp(2.0 * log_spreads)
    logs = -n_free * (log_spreads + variance / (2.0 * variances))
    return _log_mean(logs)


def _log_mean(logs: Values) -> float:
    """Compute the log of the mean likelihood over the distribution of a spread."""
    # The largest term becomes 1 before the exponential, so that no sum underflows.
    peak = float(logs.max())
    mean = np.average(np.exp(logs - peak), weights=_DEVIATE_WEIGHTS)
    return peak + math.log(float(mean))


def heading_evidence(log_lengths: Values, headings: Values, errors: HeadingErrors) -> float:
    """Compute the log likelihood ratio of things over cars from lengths by direction.

    One half of the things has boxes with shadows, the other half is as cars are: a choice.

    Args:
        log_lengths: ``[n]`` logs of lengths.
        headings: ``[n]`` directions, radians.
        errors: usual dependence of lengths on directions.
    """
    if len(log_lengths) < _MIN_OF_TREND:
        return 0.0
    with_shadows = _log_likelihood_of_trend(log_lengths, headings, errors.things, errors)
    of_cars = _log_likelihood_of_trend(log_lengths, headings, errors.cars, errors)
    return float(np.logaddexp(with_shadows - of_cars, 0.0)) - math.log(2.0)


def _log_likelihood_of_trend(
    log_lengths: Values, headings: Values, amplitude: float, errors: HeadingErrors
) -> float:
    """Compute the log likelihood of lengths that depend on directions, up to a constant.

    Amplitudes along both axes of the trend are normal; the spread around it is not known.

    Args:
        log_lengths: ``[n]``.
        headings: ``[n]`` directions, radians.
        amplitude: standard deviation of the amplitudes.
        errors: the spread around the trend.
    """
    # A box has the same length when it is turned by half a turn: the angles are doubled.
    doubled = 2.0 * headings
    axes = np.column_stack([np.cos(doubled), np.sin(doubled)])
    axes -= axes.mean(axis=0)
    deviations = log_lengths - log_lengths.mean()
    n_free = len(log_lengths) - 1

    # Along its principal axes, the trend has independent parts: their information and their sums.
    information, directions = np.linalg.eigh(axes.T @ axes)
    sums = directions.T @ (axes.T @ deviations)
    log_spreads = math.log(errors.spread) + errors.spread_log_sd * _DEVIATES
    variances = np.exp(2.0 * log_spreads)[:, None]
    of_trend = variances + amplitude**2 * np.maximum(information, 0.0)
    explained = (amplitude**2 * sums**2 / of_trend).sum(axis=1)
    residual = (float(deviations @ deviations) - explained) / variances[:, 0]
    log_determinant = np.log(of_trend / variances).sum(axis=1)
    logs = -n_free * log_spreads - (log_determinant + residual) / 2.0
    return _log_mean(logs)


def proportion_evidence(bodies: Boxes, errors: ProportionErrors, usual: float) -> float:
    """Compute the log likelihood ratio of things over cars from length over width.

    One half of the things has the proportions of cars: a choice.

    Args:
        bodies: ``[n, 5]`` at least one.
        errors: proportions of images of cars and of things.
        usual: length over width of cars.
    """
    proportions = bodies[:, 2] / bodies[:, 3]
    mean = float(np.log(proportions).mean())
    own_sd = errors.vehicle_sd / math.sqrt(len(bodies))
    from_cars = mean - math.log(usual)
    from_things = mean - math.log(errors.things)
    of_usual_cars = normal_density(from_cars, math.hypot(errors.image_sd, own_sd))
    of_others = normal_density(from_cars, errors.outlier_sd)
    of_cars = (1.0 - errors.outliers) * of_usual_cars + errors.outliers * of_others
    of_things = normal_density(from_things, math.hypot(errors.things_log_sd, own_sd))
    return math.log((of_cars + of_things) / 2.0) - math.log(of_cars)


def end_evidence(end_tones: EndTones, headings: Values, errors: EndErrors) -> float:
    """Compute the evidence for things from the colours near the ends.

    If the spread near one end is that of a shadow, whatever the one near the other end is, the
    boxes include shadows. If none is, nothing follows: the evidence is the log of one plus the
    likelihood ratio, so that it never speaks for cars.

    Args:
        end_tones: ``[n, 2, 3]`` colours, in the order of ``Appearance.end_tones``.
        headings: ``[n]`` directions of the boxes, radians.
        errors: usual spreads.
    """
    n = len(end_tones)
    if n < _MIN_OF_TREND:
        return 0.0
    # In the image, the same end comes first: that on one side of the common axis.
    axis = np.angle(np.exp(2j * headings).mean()) / 2.0
    is_turned = np.cos(headings - axis) < 0
    aligned = np.where(is_turned[:, None, None], end_tones[:, ::-1], end_tones)
    deviations = np.abs(aligned - np.median(aligned, axis=0))
    per_axis = SD_PER_MEDIAN_DEVIATION * np.median(deviations, axis=0)
    spreads = np.linalg.norm(per_axis, axis=-1)
    log_spreads = np.log(spreads + _TONE_NOISE)

    car_sd = math.hypot(errors.log_sd, errors.vehicle_log_sd / math.sqrt(n))
    shadow_sd = math.hypot(errors.things_log_sd, errors.things_vehicle_log_sd / math.sqrt(n))
    log_usual = math.log(errors.cars)
    ratios = []
    for one, other in (log_spreads, log_spreads[::-1]):
        from_cars = one - log_usual - errors.shared * (other - log_usual)
        of_usual_cars = normal_density(from_cars, car_sd)
        of_others = normal_density(from_cars, errors.outlier_log_sd)
        of_cars = (1.0 - errors.outliers) * of_usual_cars + errors.outliers * of_others
        of_things = normal_density(one - math.log(errors.things), shadow_sd)
        ratios.append(of_things / of_cars)
    # Either end can be the shadow's.
    return math.log1p((ratios[0] + ratios[1]) / 2.0)


def _logit_evidence(logits: Values, errors: LookAlikeErrors) -> float:
    """Compute the log odds of look-alikes from the mean logit of the chip network.

    The logits of few vehicles say less about their image.

    Args:
        logits: ``[n]`` log odds of a small vehicle.
        errors: typical logits of cars, and what a lower mean shows.
    """
    n = len(logits)
    reliability = n / (n + errors.logit_half_n)
    deficit = errors.mean_logit - float(np.mean(logits))
    return errors.log_odds_per_logit * reliability * deficit
