"""Effect of errors that witnesses have in common on a density of the scale."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.scale.density import blurred, flat, normalised

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.scale.density import Density
    from vehanchor.scale.reliability import Shared


def with_errors(
    density: Density, errors: Sequence[Shared], whole: Density | None = None
) -> Density:
    """Blur a density ``[g]`` by errors, and mix in the case that one of them makes it wrong.

    Args:
        density: of any sum.
        errors: independent of each other.
        whole: ``[g]`` density that the errors make wrong, if ``density`` is a part of it.
    """
    if whole is None:
        whole = density
    chance_right = math.prod(1.0 - error.chance_wrong for error in errors)
    right = blurred_by(density, errors)
    return chance_right * right + (1.0 - chance_right) * _if_wrong(whole, errors)


def _if_wrong(density: Density, errors: Sequence[Shared]) -> Density:
    """Compute the density ``[g]`` of the scale if errors make another density wrong; its sum is 1.

    Args:
        density: of any sum.
        errors: independent of each other.
    """
    chance_wrong = sum(error.chance_wrong for error in errors)
    wrong = flat()
    for error in errors:
        if error.near_share == 0.0 or error.chance_wrong == 0.0:
            continue
        near = blurred(normalised(density), error.near_log_sd)
        share = error.near_share * error.chance_wrong / chance_wrong
        wrong = wrong + share * (near - flat())
    return wrong


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
    return blurred(density, _total_log_sd(errors))


def _total_log_sd(errors: Iterable[Shared]) -> float:
    """Add independent errors: the root of the sum of their squared standard deviations."""
    return math.hypot(*(error.log_sd for error in errors))
