"""The published method to the letter: scale, composite confidence and resolution guard.

The preset ``paper`` reports it; the posterior does not use it. The weights are the paper's (section
III-D). The paper does not define the terms; their shapes were fitted on the held-out tenth of the
train split (commit ``3b3b4f3`` has the program). Outlier filter and modal length are in
``vehanchor.scale.lengths``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np

from vehanchor.scale.lengths import MIN_KDE_VEHICLES, Z95, Interval, statistical_log_sds

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vehanchor.scale.defaults import Aggregation

    LowConfidence: TypeAlias = Literal["too_coarse", "too_few", "imprecise"]
    """Cause of a confidence below 0.5."""

# Paper, section III-E: with less a planner must fall back.
FALLBACK_CONFIDENCE = 0.5
# Paper: C = min(C_raw, 0.3) under the resolution guard.
GUARD_CONFIDENCE = 0.3
# Sample term, 1 - exp(-n / 12): 5 vehicles give 0.34, 20 give 0.81.
_SAMPLE_SCALE = 12.0
# Coefficients of variation of a clean fleet, and of uninformative lengths.
_CV_FULL = 0.05
_CV_NONE = 0.25
# Median detection scores at which the quality is 0 and 1.
_SCORE_NONE = 0.55
_SCORE_FULL = 0.75
# Factor outside the trained range of lengths over which plausibility falls to 0.
_FADE = 1.5


class Terms(NamedTuple):
    """Terms of the composite confidence before weighting, each in 0..1 (paper, section III-D)."""

    sample: float = 0.0
    concentration: float = 0.0
    quality: float = 0.0
    plausibility: float = 0.0


# Paper, section III-D.
_WEIGHTS = Terms(sample=0.35, concentration=0.35, quality=0.20, plausibility=0.10)


class PaperScale(NamedTuple):
    """Scale by the published method.

    Attributes:
        gsd_m_per_px: ``L_ref / P_mode``; None without vehicles.
        confidence: composite C, under the resolution guard at most 0.3.
        terms: of the confidence.
        guarded: whether the resolution guard applies.
    """

    gsd_m_per_px: float | None
    confidence: float
    terms: Terms
    guarded: bool

    def reason(self, n_vehicles: int) -> LowConfidence | None:
        """Name the cause of a C below 0.5; None if it is not below."""
        if self.confidence >= FALLBACK_CONFIDENCE:
            return None
        if self.guarded:
            return "too_coarse"
        if n_vehicles < MIN_KDE_VEHICLES:
            return "too_few"
        return "imprecise"


def paper_scale(
    lengths: ArrayLike,
    scores: ArrayLike,
    *,
    mode_px: float | None,
    reference_length_m: float,
    reduction: float,
    guard_length_px: float,
    length_range_px: tuple[float, float],
) -> PaperScale:
    """Compute scale and composite confidence (paper, sections III-C to III-E).

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels.
        scores: ``[n]`` detection scores of the kept vehicles.
        mode_px: ``P_mode`` of ``vehanchor.scale.lengths.modal_length``; None without vehicles.
        reference_length_m: ``L_ref``.
        reduction: reduction of the image copy that the model saw.
        guard_length_px: ``P_thresh``, in pixels of that copy.
        length_range_px: shortest and longest vehicle in the model's training data.
    """
    if mode_px is None:
        return PaperScale(None, confidence=0.0, terms=Terms(), guarded=False)
    reduced_px = mode_px * reduction
    guarded = reduced_px < guard_length_px
    terms = confidence_terms(
        lengths,
        scores,
        mode_px=reduced_px,
        length_range_px=length_range_px,
    )
    return PaperScale(
        reference_length_m / mode_px,
        confidence=composite(terms, guarded=guarded),
        terms=terms,
        guarded=guarded,
    )


def paper_interval(
    lengths: ArrayLike,
    scores: ArrayLike,
    *,
    mode_px: float,
    aggregation: Aggregation,
    reference_length_m: float,
    reference_sd_m: float,
) -> Interval:
    """Compute the bootstrap interval of the scale; only the preset ``paper`` states it.

    Args:
        lengths: ``[n]`` lengths of the kept vehicles, pixels, n >= 1.
        scores: ``[n]`` detection scores of the kept vehicles.
        mode_px: ``P_mode`` of ``vehanchor.scale.lengths.modal_length``.
        aggregation: its statistic.
        reference_length_m: ``L_ref``.
        reference_sd_m: standard deviation of ``L_ref`` between regions, metres.
    """
    # The interval is lognormal, with three independent errors: of the mode, of the few cars, and of
    # the reference length.
    resampling, fleet = statistical_log_sds(lengths, scores, mode_px, aggregation)
    region = reference_sd_m / reference_length_m
    log_variance = resampling**2 + fleet**2 + region**2
    log_sd = np.sqrt(log_variance)
    factor = float(np.exp(Z95 * log_sd))
    gsd = reference_length_m / mode_px
    return Interval(gsd / factor, gsd * factor)


def confidence_terms(
    lengths: ArrayLike,
    scores: ArrayLike,
    mode_px: float,
    length_range_px: tuple[float, float],
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
    concentration = 0.0
    if len(values) >= MIN_KDE_VEHICLES:
        variation = float(np.std(values) / np.mean(values))
        concentration = _ramp(variation, zero_at=_CV_NONE, one_at=_CV_FULL)
    sample = 1.0 - np.exp(-len(values) / _SAMPLE_SCALE)
    median_score = np.median(np.asarray(scores, dtype=np.float64))
    shortest, longest = length_range_px
    log_below = np.log(shortest / mode_px)
    log_above = np.log(mode_px / longest)
    log_outside = max(log_below, log_above, 0.0)
    log_fade = float(np.log(_FADE))
    return Terms(
        sample=float(sample),
        concentration=concentration,
        quality=_ramp(float(median_score), zero_at=_SCORE_NONE, one_at=_SCORE_FULL),
        plausibility=_ramp(log_outside, zero_at=log_fade, one_at=0.0),
    )


def composite(terms: Terms, *, guarded: bool) -> float:
    """Compute C in [0, 1], the weighted sum of the terms (paper, equation 5).

    Args:
        terms: of the confidence.
        guarded: whether the resolution guard applies; C is then at most 0.3.
    """
    weighted_terms = zip(_WEIGHTS, terms, strict=True)
    total = math.fsum(weight * term for weight, term in weighted_terms)
    if guarded:
        return min(total, GUARD_CONFIDENCE)
    return total


def _ramp(value: float, *, zero_at: float, one_at: float) -> float:
    """Interpolate linearly from 0 to 1, and stay there outside."""
    share = (value - zero_at) / (one_at - zero_at)
    return float(np.clip(share, 0.0, 1.0))
