"""Chance that vehicles are equal things that are not cars, such as graves, boats or carts in rows.

Cars of one image differ in length, in appearance and in paint; things of one model hardly do. The
evidence is a likelihood ratio for each of the three: how probable the measured spread is for n
equal things, over how probable it is for n cars. Few vehicles can be alike by chance, so that they
give little evidence; four cars of one model are possible. In addition, look-alikes look less like
cars, by the chip network. There is no limit anywhere: the chance is a smooth function of all
measurements.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Appearance
    from vehanchor.detection.detector_errors import LookAlikeErrors, SpreadErrors

    Values: TypeAlias = NDArray[np.float64]
    """``[n]`` or ``[n, 3]`` measurements of vehicles."""

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
# Largest absolute log odds: no doubt is certain, and none is excluded.
_MAX_LOG_ODDS = 20.0


def chance_of_look_alikes(
    log_lengths: Values, appearance: Appearance | None, errors: LookAlikeErrors
) -> float:
    """Compute the chance, 0..1, that vehicles are look-alikes.

    Args:
        log_lengths: ``[n]`` logs of the vehicles' lengths in pixels.
        appearance: appearance of the vehicles that have any; None without a chip network.
        errors: the detector's errors about look-alikes.
    """
    log_odds = errors.log_odds
    evidence = spread_evidence(log_lengths, errors.lengths)
    if appearance is not None:
        evidence += spread_evidence(appearance.log_lengths, errors.appearance)
        log_odds += _logit_evidence(appearance.logits, errors)
        if appearance.tones is not None:
            light = _light_share(appearance.tones)
            evidence += light * spread_evidence(appearance.tones, errors.tones)
            # Only if all three spreads are known, their evidence for cars balances this rise.
            rise = errors.log_odds_per_log_n * _log_telling_number(len(log_lengths))
            log_odds += light * rise
    log_odds += errors.spread_power * evidence
    bounded = min(max(log_odds, -_MAX_LOG_ODDS), _MAX_LOG_ODDS)
    return 1.0 / (1.0 + math.exp(-bounded))


def _light_share(tones: Values) -> float:
    """Compute how much paints ``[n, 3]`` tell, 0 to 1: little in deep shadow."""
    surplus = float(np.mean(tones[:, 0])) - _EVEN_LIGHTNESS
    return 1.0 / (1.0 + math.exp(-surplus / _LIGHTNESS_WIDTH))


def _log_telling_number(n: int) -> float:
    """Compute the log of the number of vehicles, which saturates smoothly."""
    return math.log(n / (1.0 + (n - 1) / _SATURATION))


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
    # The largest term becomes 1 before the exponential, so that no sum underflows.
    peak = float(logs.max())
    mean = np.average(np.exp(logs - peak), weights=_DEVIATE_WEIGHTS)
    return peak + math.log(float(mean))


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
