"""Reliability on images of known scale: stated chances against outcomes, and errors by group.

An error above 20 % is wrong. Shares have one-sided 95 % upper bounds (Clopper and Pearson): with 0
wrong of n, about 3 / n.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field

from vehanchor_evaluation.gsd import HIGH_ERROR
from vehanchor_evaluation.result_record import ResultRecord

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor_evaluation.gsd import ScaleTrial

_CHANCE_EDGES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
_VEHICLE_EDGES = (0, 1, 5, 20, math.inf)
_RESOLUTION_EDGES_M_PER_PX = (0.0, 0.03, 0.06, 0.12, 0.2, 0.3, math.inf)
# Largest share of wrong estimates that the threshold of the confidence allows.
MAX_WRONG_SHARE = 0.01
# With 100 estimates, a share of 1 % is one image.
MIN_ESTIMATES = 100
_BOUND_PROBABILITY = 0.95


def upper_bound(wrong: int, of: int) -> float | None:
    """Compute the one-sided 95 % upper bound of a share (Clopper and Pearson).

    Args:
        wrong: number of cases.
        of: number of trials.

    Returns:
        In 0..1; None without trials.
    """
    from scipy.stats import beta

    if not of:
        return None
    # The beta distribution below is not defined when all are wrong.
    if wrong == of:
        return 1.0
    bound = beta.ppf(_BOUND_PROBABILITY, wrong + 1, of - wrong)
    return float(bound)


class ChanceRow(ResultRecord):
    """Estimates with chances in one range: the mean of the chances against the outcome."""

    low: float = Field(description="Smallest stated chance of an error below 20 %.")
    high: float = Field(description="Largest stated chance.")
    images: int = Field(ge=0, description="Estimates with such a chance.")
    stated: float | None = Field(description="Mean of their chances; null without any.")
    happened: float | None = Field(description="Share of them with an error below 20 %.")


class GroupRow(ResultRecord):
    """Images of one group: usable share, wrong ones, errors."""

    name: str = Field(description="The group.")
    images: int = Field(ge=0, description="Images.")
    estimates: int = Field(ge=0, description="Images with an estimate.")
    usable: int = Field(ge=0, description="Images with a usable scale: status ok.")
    usable_share: float | None = Field(description="usable / images.")
    wrong: int = Field(ge=0, description="Usable images with an error above 20 %.")
    wrong_bound: float | None = Field(
        description="95 % upper bound of the wrong share of usable images."
    )
    median_usable: float | None = Field(
        description="Median absolute relative error of usable images."
    )
    median: float | None = Field(description="Median absolute relative error of all estimates.")
    within_20: float | None = Field(
        description="Share of estimates with an error below 20 %, usable or not."
    )
    interval_usable: float | None = Field(
        description="Share of usable images whose 95 % interval holds the scale."
    )
    interval_others: float | None = Field(description="The same share of the other estimates.")


class ReliabilityReport(ResultRecord):
    """Reliability of the confidence on a user's images."""

    data: str = Field(description="Source of the images.")
    detector: str = Field(description="Name of the detector.")
    chances: tuple[ChanceRow, ...] = Field(description="Stated chance against outcome.")
    whole: GroupRow = Field(description="All images.")
    by_vehicles: tuple[GroupRow, ...] = Field(description="By the number of vehicles found.")
    by_resolution: tuple[GroupRow, ...] = Field(description="By the true metres per pixel.")
    threshold: float | None = Field(
        description="Smallest confidence at or above which at most 1 % of at least 100 estimates "
        "are wrong; null without one."
    )
    threshold_images: int = Field(ge=0, description="Estimates with at least this confidence.")
    threshold_wrong: int = Field(ge=0, description="The wrong ones of these.")
    threshold_bound: float | None = Field(description="95 % upper bound of their wrong share.")


class Threshold(NamedTuple):
    """Limit of the confidence, and the estimates from it on."""

    confidence: float | None
    images: int = 0
    wrong: int = 0


def confidence_threshold(confidences: Sequence[float], wrong: Sequence[bool]) -> Threshold:
    """Find the least confidence from which on at most 1 % of the estimates are wrong.

    Args:
        confidences: ``[n]`` of the estimates.
        wrong: ``[n]`` whether the error is above 20 %.

    Returns:
        No confidence if fewer than 100 estimates would remain: too few to show a share of 1 %.
    """
    confidence = np.asarray(confidences, dtype=np.float64)
    is_wrong = np.asarray(wrong, dtype=bool)
    # Only a stated confidence can be the limit: between two of them the estimates are the same.
    for limit in np.unique(confidence):
        from_limit_on = confidence >= limit
        n_estimates = int(from_limit_on.sum())
        if n_estimates < MIN_ESTIMATES:
            continue
        wrong_from_limit_on = is_wrong[from_limit_on]
        if wrong_from_limit_on.mean() <= MAX_WRONG_SHARE:
            n_wrong = int(wrong_from_limit_on.sum())
            return Threshold(float(limit), n_estimates, n_wrong)
    return Threshold(None)


def report_reliability(
    data: str,
    detector: str,
    trials: Iterable[ScaleTrial],
) -> ReliabilityReport:
    """Summarise trials.

    Args:
        data: source of the images.
        detector: its name.
        trials: estimates of images of known scale.
    """
    tried = list(trials)
    estimated = [trial for trial in tried if trial.estimated]
    threshold = confidence_threshold(
        [trial.confidence for trial in estimated],
        [trial.error > HIGH_ERROR for trial in estimated],
    )
    return ReliabilityReport(
        data=data,
        detector=detector,
        chances=tuple(_chance_rows(estimated)),
        whole=group_row("all", tried),
        by_vehicles=tuple(_rows_by_vehicles(tried)),
        by_resolution=tuple(_rows_by_resolution(tried)),
        threshold=threshold.confidence,
        threshold_images=threshold.images,
        threshold_wrong=threshold.wrong,
        threshold_bound=upper_bound(threshold.wrong, threshold.images),
    )


def _rows_by_vehicles(trials: Sequence[ScaleTrial]) -> list[GroupRow]:
    rows = []
    for low, high in pairwise(_VEHICLE_EDGES):
        # Numbers of vehicles are whole, so the name of a range includes both ends.
        if math.isinf(high):
            name = f"{low:g} and more"
        elif high - low == 1:
            name = f"{low:g}"
        else:
            name = f"{low:g} to {high - 1:g}"
        group = [trial for trial in trials if low <= _n_vehicles(trial) < high]
        rows.append(group_row(name, group))
    return rows


def _n_vehicles(trial: ScaleTrial) -> int:
    return trial.analysis.estimate.n_vehicles or 0


def _rows_by_resolution(trials: Sequence[ScaleTrial]) -> list[GroupRow]:
    rows = []
    for low, high in pairwise(_RESOLUTION_EDGES_M_PER_PX):
        name = f"{low:g} to {high:g}"
        if math.isinf(high):
            name = f"{low:g} and more"
        group = [trial for trial in trials if low <= trial.image.gsd_m_per_px < high]
        rows.append(group_row(name, group))
    return rows


def _chance_rows(estimated: Sequence[ScaleTrial]) -> list[ChanceRow]:
    rows = []
    for low, high in pairwise(_CHANCE_EDGES):
        group = [trial for trial in estimated if _is_in_range(trial.confidence, low, high)]
        row = ChanceRow(
            low=low,
            high=high,
            images=len(group),
            stated=_mean([trial.confidence for trial in group]),
            happened=_mean([trial.error < HIGH_ERROR for trial in group]),
        )
        rows.append(row)
    return rows


def _is_in_range(confidence: float, low: float, high: float) -> bool:
    """Check whether a confidence lies in a range without its end; the last range includes 1."""
    if confidence == high == 1.0:
        return True
    return low <= confidence < high


def group_row(name: str, trials: Sequence[ScaleTrial]) -> GroupRow:
    """Summarise the trials of one group."""
    estimated = [trial for trial in trials if trial.estimated]
    usable = [trial for trial in estimated if trial.usable]
    others = [trial for trial in estimated if not trial.usable]
    wrong = sum(trial.error > HIGH_ERROR for trial in usable)
    usable_share = None
    if trials:
        usable_share = len(usable) / len(trials)
    return GroupRow(
        name=name,
        images=len(trials),
        estimates=len(estimated),
        usable=len(usable),
        usable_share=usable_share,
        wrong=wrong,
        wrong_bound=upper_bound(wrong, len(usable)),
        median_usable=_median([trial.error for trial in usable]),
        median=_median([trial.error for trial in estimated]),
        within_20=_mean([trial.error < HIGH_ERROR for trial in estimated]),
        interval_usable=_mean([bool(trial.covered) for trial in usable]),
        interval_others=_mean([bool(trial.covered) for trial in others]),
    )


def _mean(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return float(np.mean(values))


def _median(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return float(np.median(values))
