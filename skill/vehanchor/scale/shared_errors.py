"""Errors that several witnesses have in common: how they blur a density, or make it wrong."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.scale.density import blurred, flat
from vehanchor.scale.reliability import Shared

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from vehanchor.scale.density import Density


def larger_errors(first: Mapping[str, Shared], second: Mapping[str, Shared]) -> dict[str, Shared]:
    """Merge errors by name; of two sizes of one error, the larger is used."""
    merged = dict(first)
    for name, error in second.items():
        same = merged.get(name, error)
        log_sd = max(error.log_sd, same.log_sd)
        chance_wrong = max(error.chance_wrong, same.chance_wrong)
        chance_large = max(error.chance_large, same.chance_large)
        large_log_sd = max(error.large_log_sd, same.large_log_sd)
        merged[name] = Shared(
            name,
            log_sd,
            chance_wrong=chance_wrong,
            chance_large=chance_large,
            large_log_sd=large_log_sd,
        )
    return merged


def with_errors(density: Density, errors: Sequence[Shared]) -> Density:
    """Blur a density ``[g]`` by errors, and mix in the case that one of them makes it wrong.

    Args:
        density: of any sum.
        errors: independent of each other.
    """
    chance_right = math.prod(1.0 - error.chance_wrong for error in errors)
    right = blurred_by(density, errors)
    return chance_right * right + (1.0 - chance_right) * flat()


def blurred_by(density: Density, errors: Sequence[Shared]) -> Density:
    """Blur a density ``[g]`` by errors that do not make it wrong.

    Args:
        density: of any sum.
        errors: independent of each other.
    """
    for k, error in enumerate(errors):
        if error.chance_large == 0.0:
            continue
        # Two cases, each with an error of one size: the usual one, and the large one.
        usual = error._replace(chance_large=0.0)
        large = usual._replace(log_sd=error.large_log_sd)
        others = (*errors[:k], *errors[k + 1 :])
        in_usual_case = blurred_by(density, (*others, usual))
        in_large_case = blurred_by(density, (*others, large))
        return (1.0 - error.chance_large) * in_usual_case + error.chance_large * in_large_case
    return blurred(density, total_log_sd(errors))


def total_log_sd(errors: Iterable[Shared]) -> float:
    """Add independent errors: the root of the sum of their squared standard deviations."""
    return math.hypot(*(error.log_sd for error in errors))
