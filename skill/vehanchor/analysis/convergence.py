"""Stopping rules for the search of an image: it ends when more tiles cannot change the scale.

With the effort ``auto``, the search of a photograph ends when the expected change of the value is
small: the standard error of the value by its vehicles, times the root of the share of vehicles in
the tiles that are not visited. Few vehicles that agree by chance do not end it.

The uncertainty of a scale has two parts. More vehicles reduce the statistical part; the uncertainty
of the fleet's length remains. The search of a large image ends when the statistical part is below
0.45 of the fleet's part at two checks in a row.

With doubts about the vehicles, or with a scale that more vehicles may make usable, no search ends
early.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.detection.scheduler import LARGE_PIXELS
from vehanchor.rulers.active import active_rulers
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.rulers.witnesses import with_doubts
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import product
from vehanchor.scale.lengths import MIN_KDE_VEHICLES
from vehanchor.scale.posterior import answer

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.detection.search import ImageSearch
    from vehanchor.options.method import Effort
    from vehanchor.rulers.ruler import View

_LEAST_FLEET_LOG_SD = 0.03  # even a known fleet differs this much between parts of a town
_CHANCE_MARGIN = 0.03  # early and full searches of nine photographs differed by at most 0.017


class Convergence(NamedTuple):
    """How far more vehicles may change the scale of an unfinished search.

    Attributes:
        share: log standard deviation from the number and the spread of the vehicles, over that from
            the fleet's unknown length; inf without vehicles, with doubts about them, or if more of
            them may make the scale usable.
        change: log standard deviation of the change that the unvisited tiles would make to the
            value; inf for fewer than five vehicles.
        density: ``[g]`` density of the scale on ``vehanchor.scale.density.GRID``; None without
            vehicles.
    """

    share: float = math.inf
    change: float = math.inf
    density: NDArray[np.float64] | None = None


class StopRule(NamedTuple):
    """Conditions that end a search.

    Attributes:
        share: limit of ``Convergence.share``.
        change: limit of ``Convergence.change``; inf for none.
        checks: number of checks in a row at which the conditions must hold.
    """

    share: float
    change: float = math.inf
    checks: int = 1


def stop_rule(effort: Effort, n_pixels: int) -> StopRule:
    """Choose the stopping rule for an image by its size and the effort."""
    if n_pixels < LARGE_PIXELS:
        return (
            StopRule(share=1.35, change=0.025)
            if effort == "fast"
            else StopRule(share=0.9, change=0.0125)
        )
    return StopRule(share=0.9) if effort == "fast" else StopRule(share=0.45, checks=2)


def search_until_settled(search: ImageSearch, view: View) -> None:
    """Search an image until more tiles cannot change its scale, by the vehicles and the prior alone.

    Args:
        search: of the image.
        view: of the image, without detections.
    """
    rule = stop_rule(view.options.search.effort, view.image.width_px * view.image.height_px)
    checks: list[Convergence] = []
    for unseen_share in search:
        seen = replace(view, detections=search.result(ended=False, check_stretch=False))
        check = convergence(seen, unseen_share)
        if check.density is not None:
            search.leave_out(check.density)
        checks.append(check)
        if has_converged(checks, rule):
            search.stop()


def convergence(view: View, unseen_share: float = 1.0) -> Convergence:
    """Measure how far more vehicles would change the scale found so far, by the vehicles and the prior alone.

    Args:
        view: of the image, with the detections so far.
        unseen_share: expected share of the image's vehicles in the tiles that are not visited.
    """
    measured = (
        ruler.measure(view) for ruler in active_rulers(view.options.rulers) if not ruler.sets_scale
    )
    vehicles = Vehicles().measure(view)
    if not vehicles.found:
        return Convergence()
    heard = with_doubts([vehicles, *(each for each in measured if each is not None and each.found)])
    found = answer(heard)
    imprecise = (
        found is not None
        and found.reason == "imprecise"
        and found.chance < USABLE_CHANCE - _CHANCE_MARGIN
    )
    # A little change of the value leaves the status as it is: usable, or clearly too imprecise.
    settled = not vehicles.doubted and found is not None and (found.usable or imprecise)
    resampling, spread = vehicles.statistical_log_sds
    return Convergence(
        math.hypot(resampling, spread) / max(vehicles.reference.log_sd, _LEAST_FLEET_LOG_SD)
        if settled
        else math.inf,
        resampling * math.sqrt(unseen_share) if vehicles.n >= MIN_KDE_VEHICLES else math.inf,
        product(*(each.density for each in heard)),
    )


def has_converged(checks: Sequence[Convergence], rule: StopRule) -> bool:
    """Test whether more tiles would change the interval and the value too little, by the last of all checks so far."""
    last = checks[-rule.checks :]
    return len(last) == rule.checks and all(
        each.share < rule.share and each.change <= rule.change for each in last
    )
