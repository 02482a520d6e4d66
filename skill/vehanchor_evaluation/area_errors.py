"""Errors of measured areas: the columns of the paper's Table II, also by category."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from pydantic import Field

from vehanchor_evaluation.result_record import ResultRecord

if TYPE_CHECKING:
    from collections.abc import Iterable

    AreaAnswer: TypeAlias = tuple[str, float | None, float]
    """Category, stated area (None for no answer) and true area of an entry."""

# A missing scale, mask or number counts as an error of 100 %.
NO_ANSWER = 1.0


class CategoryErrors(ResultRecord):
    """Errors within one category."""

    entries: int
    median: float


class AreaErrors(ResultRecord):
    """Row of the table; errors and shares are fractions."""

    name: str
    entries: int = Field(description="Areas requested.")
    answered: int = Field(description="Areas with a number; the others count as an error of 100 %.")
    median: float | None = Field(
        description="Median absolute relative error; null without entries."
    )
    mean: float | None = Field(description="Mean absolute relative error.")
    below_10: float | None = Field(description="Share of errors below 10 %.")
    below_25: float | None
    below_50: float | None
    below_100: float | None
    catastrophic: float | None = Field(description="Share of errors of 100 % or more.")
    polarisation: float | None = Field(
        description="Worst category's median error divided by the best one's; null with one "
        "category or a best of 0."
    )
    categories: dict[str, CategoryErrors]


def relative_error(area: float | None, truth: float) -> float:
    """Compute ``|area - truth| / truth``; 1 without an answer."""
    if area is None:
        return NO_ANSWER
    return abs(area / truth - 1.0)


def area_errors(name: str, answers: Iterable[AreaAnswer]) -> AreaErrors:
    """Summarise answers.

    Args:
        name: name of the row.
        answers: category, stated area (None for no answer) and true area of each entry.
    """
    entries = list(answers)
    if not entries:
        return AreaErrors(
            name=name,
            entries=0,
            answered=0,
            median=None,
            mean=None,
            below_10=None,
            below_25=None,
            below_50=None,
            below_100=None,
            catastrophic=None,
            polarisation=None,
            categories={},
        )
    errors = np.array([relative_error(area, truth) for _, area, truth in entries])
    by_category: dict[str, list[float]] = {}
    for (category, _, _), error in zip(entries, errors, strict=True):
        of_category = by_category.setdefault(category, [])
        of_category.append(float(error))
    # Categories are sorted, so that the order of the entries does not decide theirs.
    categories = {}
    for category, of_category in sorted(by_category.items()):
        median = float(np.median(of_category))
        categories[category] = CategoryErrors(entries=len(of_category), median=median)
    return AreaErrors(
        name=name,
        entries=len(entries),
        answered=sum(area is not None for _, area, _ in entries),
        median=float(np.median(errors)),
        mean=float(errors.mean()),
        below_10=float((errors < 0.10).mean()),
        below_25=float((errors < 0.25).mean()),
        below_50=float((errors < 0.50).mean()),
        below_100=float((errors < 1.00).mean()),
        catastrophic=float((errors >= 1.0).mean()),
        polarisation=_polarisation(categories.values()),
        categories=categories,
    )


def _polarisation(categories: Iterable[CategoryErrors]) -> float | None:
    """Divide the worst category's median by the best one's; None if that is undefined."""
    medians = [category.median for category in categories]
    if len(medians) < 2:
        return None
    best = min(medians)
    if best <= 0:
        return None
    ratio = max(medians) / best
    # A tiny best median makes the ratio overflow, and the record holds no infinite number.
    if not math.isfinite(ratio):
        return None
    return ratio
