"""Errors of measured areas: the columns of the paper's Table II, by category, with the polarisation ratio."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from collections.abc import Iterable

NO_ANSWER = 1.0  # a missing scale, mask or number counts as an error of 100 %


class CategoryErrors(BaseModel):
    """Errors within one category."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    entries: int
    median: float


class AreaErrors(BaseModel):
    """Row of the table; errors and shares are fractions."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

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
    return NO_ANSWER if area is None else abs(area / truth - 1.0)


def area_errors(name: str, answers: Iterable[tuple[str, float | None, float]]) -> AreaErrors:
    """Summarise answers.

    Args:
        name: name of the row.
        answers: category, stated area (None for no answer) and true area of each entry.
    """
    every = list(answers)
    errors = np.array([relative_error(area, truth) for _, area, truth in every])
    by_category: dict[str, list[float]] = {}
    for (category, _, _), error in zip(every, errors, strict=True):
        by_category.setdefault(category, []).append(float(error))
    categories = {
        category: CategoryErrors(entries=len(found), median=float(np.median(found)))
        for category, found in sorted(by_category.items())
    }
    medians = [category.median for category in categories.values()]
    ratio = max(medians) / min(medians) if len(medians) > 1 and min(medians) > 0 else None

    def below(limit: float) -> float | None:
        return float((errors < limit).mean()) if len(errors) else None

    return AreaErrors(
        name=name,
        entries=len(every),
        answered=sum(area is not None for _, area, _ in every),
        median=float(np.median(errors)) if len(errors) else None,
        mean=float(errors.mean()) if len(errors) else None,
        below_10=below(0.10),
        below_25=below(0.25),
        below_50=below(0.50),
        below_100=below(1.00),
        catastrophic=float((errors >= 1.0).mean()) if len(errors) else None,
        polarisation=ratio if ratio is not None and math.isfinite(ratio) else None,
        categories=categories,
    )
