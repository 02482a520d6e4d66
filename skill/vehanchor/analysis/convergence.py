"""Stopping rules for the search of an image: it ends when more tiles cannot change the scale.

With the effort ``auto``, the search of a photograph ends when the expected change of the value is
small: the standard error of the value by its vehicles, times the root of the share of vehicles in
the tiles that are not yet searched. A few vehicles that agree by chance do not end it.

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

    from vehanchor.detection.search import ImageSearch
    from vehanchor.options.method import Effort
    from vehanchor.rulers.ruler import View
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.density import Density
    from vehanchor.scale.posterior import Answer, Witness

# Even a known fleet differs this much between parts of a town.
_MIN_FLEET_LOG_SD = 0.03
# The chances of early and full searches of nine photographs differed by at most 0.017.
_CHANCE_MARGIN = 0.03


class Convergence(NamedTuple):
    """How far more vehicles may change the scale of an unfinished search.

    Attributes:
        share: log standard deviation from the number and the spread of the vehicles, over that from
            the fleet's unknown length; inf without vehicles, with doubts about them, or if more of
            them may make the scale usable.
        change: log standard deviation of the change that the remaining tiles would make to the
            value; inf for fewer than five vehicles.
        density: ``[g]`` density of the scale on ``vehanchor.scale.density.GRID``; None without
            vehicles.
    """

    share: float = math.inf
    change: float = math.inf
    density: Density | None = None


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
    is_fast = effort == "fast"
    if n_pixels < LARGE_PIXELS:
        if is_fast:
            return StopRule(share=1.35, change=0.025)
        return StopRule(share=0.9, change=0.0125)
    if is_fast:
        return StopRule(share=0.9)
    return StopRule(share=0.45, checks=2)


def search_until_settled(search: ImageSearch, view: View) -> None:
    """Search an image until more tiles cannot change its scale.

    The scale is that of the vehicles and the prior alone.

    Args:
        search: search of the image.
        view: view of the image, without detections.
    """
    n_pixels = view.image.width_px * view.image.height_px
    rule = stop_rule(view.options.search.effort, n_pixels)
    checks: list[Convergence] = []
    for unseen_share in search:
        detections = search.result(ended=False, check_stretch=False)
        so_far = replace(view, detections=detections)
        check = convergence(so_far, unseen_share)
        if check.density is not None:
            # Resolutions that this scale makes superfluous are left out.
            search.leave_out(check.density)
        checks.append(check)
        if has_converged(checks, rule):
            search.stop()


def convergence(view: View, unseen_share: float = 1.0) -> Convergence:
    """Measure how far more vehicles would change the scale that was found so far.

    The scale is that of the vehicles and the prior alone.

    Args:
        view: view of the image, with the detections so far.
        unseen_share: expected share of the image's vehicles in the tiles that are not yet searched.
    """
    vehicles = Vehicles().measure(view)
    if not vehicles.found:
        return Convergence()
    witnesses = with_doubts([vehicles, *_priors(view)])
    share = math.inf
    change = math.inf
    resampling, spread = vehicles.statistical_log_sds
    if _status_is_settled(vehicles, answer(witnesses)):
        fleet_log_sd = max(vehicles.reference.log_sd, _MIN_FLEET_LOG_SD)
        share = math.hypot(resampling, spread) / fleet_log_sd
    if vehicles.n >= MIN_KDE_VEHICLES:
        change = resampling * math.sqrt(unseen_share)
    densities = [witness.density for witness in witnesses]
    return Convergence(share, change, product(*densities))


def _priors(view: View) -> list[Witness]:
    """Measure with the rulers that never set the scale."""
    witnesses = []
    for ruler in active_rulers(view.options.rulers):
        if ruler.sets_scale:
            continue
        witness = ruler.measure(view)
        if witness is not None and witness.found:
            witnesses.append(witness)
    return witnesses


def _status_is_settled(vehicles: VehicleWitness, so_far: Answer | None) -> bool:
    """Test whether a small change of the value leaves the status as it is.

    The scale is then usable, or clearly too imprecise.
    """
    if vehicles.doubted or so_far is None:
        return False
    if so_far.usable:
        return True
    is_far_below = so_far.chance < USABLE_CHANCE - _CHANCE_MARGIN
    return so_far.reason == "imprecise" and is_far_below


def has_converged(checks: Sequence[Convergence], rule: StopRule) -> bool:
    """Test whether more tiles would change the interval and the value too little.

    Args:
        checks: all checks so far; the last ones decide.
        rule: conditions that end the search.
    """
    last = checks[-rule.checks :]
    if len(last) < rule.checks:
        return False
    are_precise = all(check.share < rule.share for check in last)
    are_stable = all(check.change <= rule.change for check in last)
    return are_precise and are_stable
