"""Decide on the scale from all evidence by one rule: a witness is right, or it says nothing.

A witness measured what it is meant to measure, or something else. In the second case it says
nothing: all scales are equally likely, and its density is flat. All densities are over the log of
the ground sampling distance::

    factor    = (1 - c) right + c flat                       a witness that is wrong with chance c
    group     = (1 - s) blur(product of factors) + s flat    witnesses that share an error
    posterior = product of all factors and groups, normalised

Witnesses share an error if it has one cause, such as one lens, one height or one caller. Therefore
they do not confirm each other beyond that error: its standard deviation blurs their product, and
with the chance s the error makes all of them wrong.

A guess about a measurement, such as the length of the cars, is a witness that says nothing if the
measurement is wrong. It narrows the scale, and is no evidence that the measurement is right.

The answer follows from this posterior alone:

* The value is the median, given that at least one witness that can set a scale is right.
* The interval is the central 95 % of the same distribution. It is extended to cover witnesses that
  are probably right, but exclude each other.
* The chance is the posterior's mass within 20 % of the value. What a caller assumes gains no
  chance by the agreement of a prior.
* The scale is usable if the chance is at least 0.9.
* The reason is the weakness whose removal would raise the chance most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.defaults import PROBABLY_RIGHT, USABLE_CHANCE
from vehanchor.scale.density import (
    MIN_PROBABILITY,
    credible_interval,
    mass_within,
    normalised,
    quantile,
)
from vehanchor.scale.lengths import Interval
from vehanchor.scale.reliability import MAX_CHANCE
from vehanchor.scale.shared_errors import blurred_by
from vehanchor.scale.witness import JointPosterior, Witness

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.scale.defaults import Reason
    from vehanchor.scale.density import Density

# Smallest rise of the chance that makes a weakness the reason.
_MIN_GAIN = 1e-6


@dataclass(frozen=True, eq=False)
class Answer:
    """Scale by all witnesses.

    Attributes:
        gsd_m_per_px: the value, metres per pixel.
        interval: 95 % interval, metres per pixel.
        chance: 0..1, chance of an error below 20 %.
        density: ``[g]`` posterior, given that at least one witness that can set a scale is right.
        posterior: ``[g]`` whole posterior, also of the case that none of them is right.
        p_right: chance of each witness with a finding that it is right; these do not add up to 1.
        leading: index of the setting witness without which the interval is widest, of those that
            are probably right.
        reason: why the scale is not usable; None if it is.
        contradictions: pairs of probably right witnesses of which each excludes the other's scale.
    """

    gsd_m_per_px: float
    interval: Interval
    chance: float
    density: Density = field(repr=False)
    posterior: Density = field(repr=False)
    p_right: tuple[float, ...] = ()
    leading: int = 0
    reason: Reason | None = None
    contradictions: tuple[tuple[int, int], ...] = ()

    @property
    def usable(self) -> bool:
        """Whether a planner may act on the scale."""
        return self.chance >= USABLE_CHANCE


def answer(witnesses: Sequence[Witness]) -> Answer | None:
    """Decide on the scale, and explain the decision.

    Args:
        witnesses: of all rulers; those that found nothing do not change the answer.

    Returns:
        The answer; None without a witness that can set a scale.
    """
    witnesses = [witness for witness in witnesses if witness.found]
    decision = judge(witnesses)
    if decision is None:
        return None
    posterior = JointPosterior(witnesses)
    p_right = []
    answers_without = []
    for k in range(len(witnesses)):
        # P(witness k is right | all witnesses) is one minus the part in which it is wrong, and the
        # part in which an error of it is large: its own scale is wrong, too.
        if_right = posterior.density - posterior.part_if_wrong([k])
        p_usual = float((if_right * _share_of_usual_errors(witnesses[k])).sum())
        p_right.append(max(0.0, p_usual))
        answers_without.append(judge(_all_but(witnesses, k)))
    reason = None
    if not decision.usable:
        reason = _weakness(witnesses, answers_without, decision.chance)
    contradictions = _contradictions(witnesses, p_right)
    # A compromise between witnesses that exclude each other is no more exact than they are apart.
    intervals = [witnesses[k].interval for pair in contradictions for k in pair]
    return replace(
        decision,
        interval=_hull(decision.interval, intervals),
        contradictions=contradictions,
        p_right=tuple(p_right),
        leading=_leading(witnesses, answers_without, p_right),
        reason=reason,
    )


def judge(witnesses: Sequence[Witness]) -> Answer | None:
    """Compute value, interval and chance of the answer, without its explanation.

    Args:
        witnesses: as in ``answer``.

    Returns:
        The answer without ``p_right``, ``leading`` and ``reason``; None as in ``answer``.
    """
    witnesses = [witness for witness in witnesses if witness.found]
    setting = [k for k, witness in enumerate(witnesses) if witness.sets_scale]
    if not setting:
        return None
    posterior = JointPosterior(witnesses)

    # A scale needs a setting witness that is right. The part of the posterior in which none is
    # right comes from priors and flat densities: it would draw the median towards the middle of
    # the grid. It therefore counts in the chance, but not in the value.
    unsupported = posterior.part_if_wrong(setting)
    supported = normalised(np.maximum(posterior.density - unsupported, 0.0) + MIN_PROBABILITY)
    value = quantile(supported, 0.5)
    chance = mass_within(posterior.density, value)
    if any(witness.assumed for witness in witnesses):
        confirmed = _guesses_confirmed_by_priors(witnesses, posterior)
        chance -= max(0.0, mass_within(confirmed, value))
    return Answer(
        value,
        interval=credible_interval(supported),
        chance=min(chance, MAX_CHANCE),
        density=supported,
        posterior=posterior.density,
    )


def _share_of_usual_errors(witness: Witness) -> Density:
    """Compute the chance ``[g]`` that no error of a right witness is large, for each true scale."""
    assert witness.right is not None
    if all(error.chance_large == 0.0 for error in witness.shared):
        return np.ones_like(witness.right)
    usual_errors = [error._replace(chance_large=0.0) for error in witness.shared]
    usual = blurred_by(witness.right, usual_errors)
    p_usual = math.prod(1.0 - error.chance_large for error in witness.shared)
    whole = blurred_by(witness.right, witness.shared)
    return np.minimum(p_usual * usual / np.maximum(whole, MIN_PROBABILITY), 1.0)


def _guesses_confirmed_by_priors(
    witnesses: Sequence[Witness], posterior: JointPosterior
) -> Density:
    """Compute the mass ``[g]`` that a guess of the caller gains because a prior agrees with it.

    A prior may narrow a guess, but not confirm it: a guess near the usual scale is no more likely
    to be right. The mass is the difference, with and without priors, of the part in which no
    found or measured witness is right.
    """
    without_priors = [witness for witness in witnesses if witness.sets_scale]
    with_priors = posterior.part_if_wrong(_found_or_measured(witnesses))
    alone = JointPosterior(without_priors).part_if_wrong(_found_or_measured(without_priors))
    return with_priors - alone


def _found_or_measured(witnesses: Sequence[Witness]) -> list[int]:
    """List the indices of the setting witnesses that do not rest on a guess of the caller."""
    return [k for k, witness in enumerate(witnesses) if witness.sets_scale and not witness.assumed]


def _all_but(witnesses: Sequence[Witness], k: int) -> list[Witness]:
    """Leave out one witness."""
    return [*witnesses[:k], *witnesses[k + 1 :]]


def _contradictions(
    witnesses: Sequence[Witness], p_right: Sequence[float]
) -> tuple[tuple[int, int], ...]:
    """List the pairs of probably right setting witnesses that exclude each other.

    Each lies outside the other's interval. The scale of a witness that is probably wrong is
    explained by its chance to be wrong.
    """
    setting = [
        k
        for k, witness in enumerate(witnesses)
        if witness.sets_scale and p_right[k] >= PROBABLY_RIGHT
    ]
    pairs = combinations(setting, 2)
    return tuple((a, b) for a, b in pairs if _exclude_each_other(witnesses[a], witnesses[b]))


def _exclude_each_other(first: Witness, second: Witness) -> bool:
    """Test whether the scale of each of two witnesses lies outside the other's 95 % interval."""
    if first.gsd_m_per_px is None or second.gsd_m_per_px is None:
        return False
    return not (_allows(first, second.gsd_m_per_px) or _allows(second, first.gsd_m_per_px))


def _allows(witness: Witness, gsd_m_per_px: float) -> bool:
    """Test whether a scale lies in the 95 % interval of a witness."""
    interval = witness.interval
    return interval is not None and interval.low <= gsd_m_per_px <= interval.high


def _hull(interval: Interval, others: Iterable[Interval | None]) -> Interval:
    """Extend an interval to cover others."""
    low, high = interval
    for other in others:
        if other is not None:
            low = min(low, other.low)
            high = max(high, other.high)
    return Interval(low, high)


def _leading(
    witnesses: Sequence[Witness],
    answers_without: Sequence[Answer | None],
    p_right: Sequence[float],
) -> int:
    """Find the setting witness that narrows the interval most; one that is probably right first."""
    ranks = {}
    for k, witness in enumerate(witnesses):
        if not witness.sets_scale:
            continue
        width = math.inf
        answer_without = answers_without[k]
        if answer_without is not None:
            width = answer_without.interval.high / answer_without.interval.low
        ranks[k] = (p_right[k] >= PROBABLY_RIGHT, width)
    return max(ranks, key=lambda k: ranks[k])


def _weakness(
    witnesses: Sequence[Witness], answers_without: Sequence[Answer | None], chance: float
) -> Reason:
    """Name the weakness whose removal would raise the chance most."""
    best_reason: Reason = "imprecise"
    best_gain = _MIN_GAIN
    for k, witness in enumerate(witnesses):
        others = _all_but(witnesses, k)
        remedied: list[tuple[Reason, Answer | None]] = [
            (lack.reason, judge([*others, lack.without])) for lack in witness.lacks
        ]
        # A witness without which the chance rises contradicts the others.
        remedied.append(("disagree", answers_without[k]))
        for reason, better in remedied:
            if better is None:
                continue
            gain = better.chance - chance
            if gain > best_gain:
                best_reason = reason
                best_gain = gain
    return best_reason
