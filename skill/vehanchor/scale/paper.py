"""The published method to the letter: outlier filter, modal length, scale, composite confidence, resolution guard.

The preset ``paper`` reports it; it never meets the posterior. The weights are the paper's (section
III-D). The shapes of the terms were fitted on the held-out tenth of the train split (commit
``3b3b4f3`` has the program).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from vehanchor.scale.lengths import MIN_KDE_VEHICLES, Z95, Interval, statistical_log_sds

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vehanchor.scale.defaults import Aggregation

FALLBACK_CONFIDENCE = 0.5  # paper, section III-E: with less a planner must fall back
GUARD_CONFIDENCE = 0.3  # paper: C = min(C_raw, 0.3)
_SAMPLE_SCALE = 12.0  # vehicles; 1 - exp(-n / 12): 5 give 0.34, 20 give 0.81
# coefficient of variation of a clean fleet, and of uninformative lengths
_CV_FULL = 0.05
_CV_NONE = 0.25
# median detection score
_SCORE_NONE = 0.55
_SCORE_FULL = 0.75
_FADE = 1.5  # factor outside the trained range over which plausibility falls to 0


class Terms(NamedTuple):
    """Four terms of the composite confidence before weighting, each in 0..1 (paper, section III-D)."""

    sample: float = 0.0
    concentration: float = 0.0
    quality: float = 0.0
    plausibility: float = 0.0


_WEIGHTS = Terms(sample=0.35, concentration=0.35, quality=0.20, plausibility=0.10)  # paper


class PaperScale(NamedTuple):
    """Scale by the published method.

    Attributes:
        gsd_m_per_px: ``L_ref / P_mode``; None without vehicles.
        interval: bootstrap interval; None without vehicles.
        confidence: composite C, under the resolution guard at most 0.3.
        terms: of the confidence.
        guarded: whether the resolution guard applies.
    """

    gsd_m_per_px: float | None
    interval: Interval | None
    confidence: float
    terms: Terms
    guarded: bool

    def reason(self, n_vehicles: int) -> Literal["too_coarse", "too_few", "imprecise"] | None:
        """Say why C is below 0.5; None if it is not."""
        if self.confidence >= FALLBACK_CONFIDENCE:
            return None
        return (
            "too_coarse"
            if self.guarded
            else "too_few"
            if n_vehicles < MIN_KDE_VEHICLES
            else "imprecise"
        )


def paper_scale(
    lengths: ArrayLike,
    scores: ArrayLike,
    mode: tuple[float | None, Aggregation],
    reference_m: tuple[float, float],
    *,
    reduction: float,
    guard_length_px: float,
    length_range_px: tuple[float, float],
) -> PaperScale:
    """Compute scale and composite confidence (paper, sections III-C to III-E).

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels.
        scores: ``[n]`` detection scores of the kept vehicles.
        mode: their modal length and its statistic, from ``vehanchor.scale.lengths.modal_length``.
        reference_m: ``L_ref`` and its standard deviation between regions, metres.
        reduction: scale of the image copy that the model saw.
        guard_length_px: ``P_thresh``, in pixels of that copy.
        length_range_px: shortest and longest vehicle in the model's training data.
    """
    mode_px, aggregation = mode
    if mode_px is None:
        return PaperScale(None, None, confidence=0.0, terms=Terms(), guarded=False)
    length_m = reference_m[0]
    log_sd = reference_m[1] / reference_m[0]
    gsd = length_m / mode_px
    (resampling, fleet) = statistical_log_sds(lengths, scores, mode_px, aggregation)
    # of a lognormal 95 % interval
    reach = float(np.exp(Z95 * np.sqrt(resampling**2 + fleet**2 + log_sd**2)))
    terms = confidence_terms(
        lengths, scores, mode_px=mode_px * reduction, length_range_px=length_range_px
    )
    guarded = mode_px * reduction < guard_length_px
    return PaperScale(
        gsd,
        Interval(gsd / reach, gsd * reach),
        confidence=composite(terms, guarded=guarded),
        terms=terms,
        guarded=guarded,
    )


def confidence_terms(
    lengths: ArrayLike, scores: ArrayLike, mode_px: float, length_range_px: tuple[float, float]
) -> Terms:
    """Compute the four terms, each in [0, 1].

    * sample: ``1 - exp(-n / 12)``.
    * concentration: 1 at a coefficient of variation of 0.05, 0 at 0.25, linear between; 0 with
      fewer than 5 vehicles, because one false alarm has no spread. Together with the sample term
      this keeps C below 0.5 for N' < 5.
    * quality: median score, 0 at 0.55, 1 at 0.75.
    * plausibility: 1 while ``mode_px`` is in the model's range, falling to 0 over a factor of 1.5
      outside it.

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels, n >= 1.
        scores: ``[n]`` detection scores of the kept vehicles.
        mode_px: ``P_mode``.
        length_range_px: shortest and longest vehicle in the model's training data.
    """
    values = np.asarray(lengths, dtype=np.float64)
    score = np.asarray(scores, dtype=np.float64)
    variation = float(np.std(values) / np.mean(values))
    shortest, longest = length_range_px
    outside = max(np.log(shortest / mode_px), np.log(mode_px / longest), 0.0)
    return Terms(
        sample=float(1.0 - np.exp(-len(values) / _SAMPLE_SCALE)),
        concentration=_ramp(variation, _CV_NONE, _CV_FULL)
        if len(values) >= MIN_KDE_VEHICLES
        else 0.0,
        quality=_ramp(float(np.median(score)), _SCORE_NONE, _SCORE_FULL),
        plausibility=_ramp(outside, float(np.log(_FADE)), 0.0),
    )


def composite(terms: Terms, *, guarded: bool) -> float:
    """Compute the weighted sum of the terms, C in [0, 1] (paper, equation 5), under the guard at most 0.3."""
    total = math.fsum(weight * term for weight, term in zip(_WEIGHTS, terms, strict=True))
    return min(total, GUARD_CONFIDENCE) if guarded else total


def _ramp(value: float, zero_at: float, one_at: float) -> float:
    return float(np.clip((value - zero_at) / (one_at - zero_at), 0.0, 1.0))
