"""Composite confidence: four terms with the paper's weights, and doubts about the fleet, which limit any confidence.

The weights are the paper's (section III-D). The shapes of the terms were fitted on the held-out tenth of the train
split by ``research/training/detector/fit_confidence.py``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records import ConfidenceTerms
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.lengths import MIN_KDE_VEHICLES
from vehanchor.scale.thresholds import DISPUTE_CONFIDENCE, GUARD_CONFIDENCE

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_RIVAL_SHARE = 0.35  # of the dominant group's weight in another group of lengths
_ALIKE_LOG_SPREAD = 0.045  # 99 of 100 fleets of the train split have 0.047 and more; equal things in rows 0.03 to 0.06
_ALIKE_LOG_ODDS = 0.7  # standard deviation; fleets have 0.6 and more, caravans in rows 0.4 to 0.7
_EQUAL_LOG_SPREAD = 0.065  # equal things in rows have 0.03 to 0.06
_UNLIKE_LOG_ODDS = -3.2  # mean; fleets of the train split have -2.9 and more, boats in rows -2.5 to -4.5
_ALIKE_VEHICLES = 20  # least number of vehicles, with which the spread is known to a sixth
_CLEAR_PERCENTILE = 90
_CLEAR_OF_FEW = 0.32  # divided by the number of vehicles: tolerance for the best scores of a few cars
_CLEAR_VERIFIED = 0.94  # by the car verifier; 170 of 172 right scales of the held-out tenth have 0.944 and more
_WEIGHTS = ConfidenceTerms.model_construct(sample=0.35, concentration=0.35, quality=0.20, plausibility=0.10)  # paper

_SAMPLE_SCALE = 12.0  # vehicles; 1 - exp(-n / 12): 5 give 0.34, 20 give 0.81
_CV_FULL, _CV_NONE = 0.05, 0.25  # coefficient of variation of a clean fleet, and of uninformative lengths
_SCORE_NONE, _SCORE_FULL = 0.55, 0.75  # median detection score
_QUARTILES_PER_SD = 1.349  # of a normal distribution
_FADE = 1.5  # factor outside the trained range over which plausibility falls to 0


def _ramp(value: float, zero_at: float, one_at: float) -> float:
    return float(np.clip((value - zero_at) / (one_at - zero_at), 0.0, 1.0))


def confidence_terms(
    lengths: ArrayLike, scores: ArrayLike, mode_px: float, length_range_px: tuple[float, float]
) -> ConfidenceTerms:
    """Compute the four terms, each in [0, 1].

    * sample: ``1 - exp(-n / 12)``.
    * concentration: 1 at a coefficient of variation of 0.05, 0 at 0.25, linear between; 0 with fewer than 5 vehicles,
      because one false alarm has no spread. Together with the sample term this keeps C below 0.5 for N' < 5.
    * quality: median score, 0 at 0.55, 1 at 0.75.
    * plausibility: 1 while ``mode_px`` is in the model's range, falling to 0 over a factor of 1.5 outside it.

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels.
        scores: ``[n]`` detection scores of the kept vehicles.
        mode_px: ``P_mode``.
        length_range_px: shortest and longest vehicle in the model's training data.

    Returns:
        The terms; all zero for no vehicles.
    """
    values, score = np.asarray(lengths, dtype=np.float64), np.asarray(scores, dtype=np.float64)
    if len(values) == 0:
        return ConfidenceTerms(sample=0.0, concentration=0.0, quality=0.0, plausibility=0.0)
    variation = float(np.std(values) / np.mean(values))
    shortest, longest = length_range_px
    outside = max(np.log(shortest / mode_px), np.log(mode_px / longest), 0.0)
    return ConfidenceTerms(
        sample=float(1.0 - np.exp(-len(values) / _SAMPLE_SCALE)),
        concentration=_ramp(variation, _CV_NONE, _CV_FULL) if len(values) >= MIN_KDE_VEHICLES else 0.0,
        quality=_ramp(float(np.median(score)), _SCORE_NONE, _SCORE_FULL),
        plausibility=_ramp(outside, float(np.log(_FADE)), 0.0),
    )


def fleet_doubts(
    lengths: ArrayLike,
    scores: ArrayLike,
    *,
    rival_share: float,
    clear_score: float,
    fleet_log_odds: ArrayLike | None = None,
    stretch: float | None = None,
    verified: bool = False,
) -> tuple[NoticeCode, ...]:
    """List the doubts that the vehicles are cars, after a search over scales, which does not use their size.

    * ``stretched``: the vehicles prefer a narrower or wider image more than in images of true proportions.
    * ``lengths_disagree``: another group of lengths has at least 0.35 of the weight of this one.
    * ``lengths_alike``: the log lengths of 20 or more vehicles spread by less than 0.045 (interquartile range over
      1.349), as in a yard of equal lorries, containers or roof units. Makes and models of cars differ by 0.08.
    * ``scores_unclear``: fewer than a tenth of the vehicles reach the clear score minus 0.32 over their number. The
      2nd percentile of random draws from 113 train images with 20 and more cars is 0.69 for 5 cars, 0.72 for 12, 0.74
      for 20 and 0.75 for all (``research/training/verifier/calibrate.py``). Scores of the car verifier are higher: its
      limit is 0.94 for any number.
    * ``looks_alike``: the fleet log odds (``vehanchor.detection.appearance``) of 20 or more vehicles spread by less
      than 0.7, and their log lengths by less than 0.065: equal things have equal lengths, too.
    * ``looks_unlike_cars``: the mean fleet log odds of 20 or more vehicles are below -3.2, lower than in any fleet.

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels.
        scores: ``[n]`` detection scores of the kept vehicles.
        rival_share: see ``vehanchor.scale.lengths.dominant_group``.
        clear_score: score that the best tenth of a fleet reaches with this model; 0 if unknown.
        fleet_log_odds: ``[m]`` log odds of the vehicles with a chip; None without a fleet network.
        stretch: see ``vehanchor.detection.proportions``; None if unknown, or in a tilted view.
        verified: whether the car verifier scored the vehicles.

    Returns:
        The doubts as notice codes; empty without vehicles.
    """
    values, score = np.asarray(lengths, dtype=np.float64), np.asarray(scores, dtype=np.float64)
    if len(values) == 0:
        return ()
    doubts: list[NoticeCode] = []
    if stretch is not None and abs(stretch) > 1.0:
        doubts.append(NoticeCode.STRETCHED)
    if rival_share >= _RIVAL_SHARE:
        doubts.append(NoticeCode.LENGTHS_DISAGREE)
    low, high = np.percentile(np.log(values), [25, 75])
    spread = (high - low) / _QUARTILES_PER_SD
    if len(values) >= _ALIKE_VEHICLES and spread < _ALIKE_LOG_SPREAD:
        doubts.append(NoticeCode.LENGTHS_ALIKE)
    clear = _CLEAR_VERIFIED if verified else clear_score - _CLEAR_OF_FEW / len(values)
    if np.percentile(score, _CLEAR_PERCENTILE) < clear:
        doubts.append(NoticeCode.SCORES_UNCLEAR)
    odds = np.asarray([] if fleet_log_odds is None else fleet_log_odds, dtype=np.float64)
    if len(odds) >= _ALIKE_VEHICLES:
        if odds.std() < _ALIKE_LOG_ODDS and spread < _EQUAL_LOG_SPREAD:
            doubts.append(NoticeCode.LOOKS_ALIKE)
        if odds.mean() < _UNLIKE_LOG_ODDS:
            doubts.append(NoticeCode.LOOKS_UNLIKE_CARS)
    return tuple(doubts)


def composite(terms: ConfidenceTerms, *, guarded: bool, disputed: bool = False) -> float:
    """Compute the weighted sum of the terms (paper, equation 5).

    Args:
        terms: result of ``confidence_terms``.
        guarded: whether the resolution guard applies; it limits C to 0.3.
        disputed: whether there are doubts that the vehicles are cars (``fleet_doubts``); they limit C to 0.4.

    Returns:
        C in [0, 1].
    """
    total = (
        _WEIGHTS.sample * terms.sample
        + _WEIGHTS.concentration * terms.concentration
        + _WEIGHTS.quality * terms.quality
        + _WEIGHTS.plausibility * terms.plausibility
    )
    return min(total, largest_confidence(guarded=guarded, disputed=disputed))


def largest_confidence(*, guarded: bool, disputed: bool) -> float:
    """Choose the limit of the confidence in vehicles: 0.3 under the resolution guard, 0.4 with doubts, else 1."""
    return GUARD_CONFIDENCE if guarded else DISPUTE_CONFIDENCE if disputed else 1.0
