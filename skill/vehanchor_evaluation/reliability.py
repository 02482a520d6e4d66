"""Reliability on images of known scale: stated chances against outcomes, usable share, errors by cars and resolution.

An error above 20 % is wrong. Shares have one-sided 95 % upper bounds (Clopper and Pearson): with 0
wrong of n, 3 / n.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from vehanchor_evaluation.gsd import HIGH_ERROR

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor_evaluation.gsd import ScaleTrial

_CHANCES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 1.0)
_CARS = (0, 1, 5, 20)
_RESOLUTIONS_M_PER_PX = (0.0, 0.03, 0.06, 0.12, 0.2, 0.3)
WANTED_SHARE = 0.01
LEAST_ESTIMATES = 100  # with which a share of 1 % is one image
_PROBABILITY = 0.95


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
    return 1.0 if wrong == of else float(beta.ppf(_PROBABILITY, wrong + 1, of - wrong))


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ChanceRow(_Row):
    """Estimates with chances in one range: the mean of the chances against the outcome."""

    low: float = Field(description="Smallest stated chance of an error below 20 %.")
    high: float = Field(description="Largest stated chance.")
    images: int = Field(ge=0, description="Estimates with such a chance.")
    stated: float | None = Field(description="Mean of their chances; null without any.")
    happened: float | None = Field(description="Share of them with an error below 20 %.")


class GroupRow(_Row):
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


class ReliabilityReport(_Row):
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
        No confidence if fewer than 100 estimates would remain: their share cannot be told from 1 %.
    """
    said = np.asarray(confidences, dtype=np.float64)
    missed = np.asarray(wrong, dtype=bool)
    for limit in np.unique(said):
        kept = said >= limit
        if kept.sum() >= LEAST_ESTIMATES and missed[kept].mean() <= WANTED_SHARE:
            return Threshold(float(limit), int(kept.sum()), int(missed[kept].sum()))
    return Threshold(None)


def report_reliability(data: str, detector: str, trials: Iterable[ScaleTrial]) -> ReliabilityReport:
    """Summarise trials.

    Args:
        data: source of the images.
        detector: its name.
        trials: estimates of images of known scale.
    """
    tried = list(trials)
    known = [trial for trial in tried if trial.estimated]
    found = confidence_threshold(
        [trial.analysis.estimate.confidence for trial in known],
        [trial.error > HIGH_ERROR for trial in known],
    )
    return ReliabilityReport(
        data=data,
        detector=detector,
        chances=tuple(_chance_rows(known)),
        whole=group_row("all", tried),
        by_vehicles=tuple(
            group_row(
                name,
                [
                    trial
                    for trial in tried
                    if low <= (trial.analysis.estimate.n_vehicles or 0) < high
                ],
            )
            for name, low, high in _ranges(_CARS, "{:g} to {:g}", least=1)
        ),
        by_resolution=tuple(
            group_row(name, [trial for trial in tried if low <= trial.image.gsd_m_per_px < high])
            for name, low, high in _ranges(_RESOLUTIONS_M_PER_PX, "{:g} to {:g}")
        ),
        threshold=found.confidence,
        threshold_images=found.images,
        threshold_wrong=found.wrong,
        threshold_bound=upper_bound(found.wrong, found.images),
    )


def _ranges(edges: Sequence[float], words: str, least: int = 0) -> list[tuple[str, float, float]]:
    """Name half-open ranges between edges; with ``least``, of whole numbers, whose names include both ends."""
    named = []
    for low, high in itertools.pairwise((*edges, math.inf)):
        if math.isinf(high):
            name = f"{low:g} and more"
        elif high - low == least:
            name = f"{low:g}"
        else:
            name = words.format(low, high - least)
        named.append((name, low, high))
    return named


def _chance_rows(known: Sequence[ScaleTrial]) -> list[ChanceRow]:
    told = [(trial.analysis.estimate.confidence, trial.error < HIGH_ERROR) for trial in known]
    rows = []
    for low, high in itertools.pairwise(_CHANCES):
        some = [
            (chance, right)
            for chance, right in told
            if low <= chance and (chance < high or high == 1.0)
        ]
        stated, happened = (_mean([pair[k] for pair in some]) for k in (0, 1))
        rows.append(
            ChanceRow(low=low, high=high, images=len(some), stated=stated, happened=happened)
        )
    return rows


def group_row(name: str, trials: Sequence[ScaleTrial]) -> GroupRow:
    """Summarise the trials of one group."""
    known = [trial for trial in trials if trial.estimated]
    usable = [trial for trial in known if trial.analysis.estimate.status == "ok"]
    others = [trial for trial in known if trial.analysis.estimate.status != "ok"]
    wrong = sum(trial.error > HIGH_ERROR for trial in usable)
    return GroupRow(
        name=name,
        images=len(trials),
        estimates=len(known),
        usable=len(usable),
        usable_share=len(usable) / len(trials) if trials else None,
        wrong=wrong,
        wrong_bound=upper_bound(wrong, len(usable)),
        median_usable=_median([trial.error for trial in usable]),
        median=_median([trial.error for trial in known]),
        within_20=_mean([trial.error < HIGH_ERROR for trial in known]),
        interval_usable=_mean([bool(trial.covered) for trial in usable]),
        interval_others=_mean([bool(trial.covered) for trial in others]),
    )


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None
