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
A mistake can also be a near one: then they are wrong, and the scale is near what they give.

A guess about a measurement, such as the length of the cars, is a witness that says nothing if the
measurement is wrong. It narrows the scale, and is no evidence that the measurement is right.

The answer follows from this posterior alone:

* The value is the median, given that at least one witness that can set a scale is right.
* The interval is the central 95 % of the same distribution. It is extended to cover witnesses that
  are probably right, but exclude each other.
* The chance is the posterior's mass within 20 % of the value. What a caller assumes or measured
  gains no chance by the agreement of a prior. What is stated, by the caller or the file, loses
  chance where what is seen in the picture excludes it. Of two witnesses that exclude each other and
  are further than 20 % apart, only one counts.
* The scale is usable if the chance is at least 0.9.
* The reason is the weakness whose removal would raise the chance most.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vehanchor.scale.defaults import PROBABLY_RIGHT, USABLE_CHANCE
from vehanchor.scale.density import (
    MIN_PROBABILITY,
    TOLERANCE,
    credible_interval,
    flat,
    mass_within,
    normalised,
    product,
    quantile,
)
from vehanchor.scale.groups import group_by_shared_errors
from vehanchor.scale.lengths import Interval
from vehanchor.scale.reliability import CONTRADICTION_POWER, FILE, MAX_CHANCE, MEASURING, Shared
from vehanchor.scale.shared_errors import blurred_by, with_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from vehanchor.scale.defaults import Reason
    from vehanchor.scale.density import Density
    from vehanchor.scale.groups import Group

# Smallest rise of the chance that makes a weakness the reason.
_MIN_GAIN = 1e-6


class Mark(NamedTuple):
    """Measured line of a ruler, or a labelled point.

    Attributes:
        points: its corners, x and y in pixels of the image; a label can have a single point.
        label: text beside its middle, such as "60 m"; empty for none.
        closed: whether the last corner is connected to the first.
    """

    points: tuple[tuple[float, float], ...]
    label: str = ""
    closed: bool = False


class Remark(Protocol):
    """Warning of a ruler."""

    @property
    def code(self) -> str:
        """Stable identifier."""

    @property
    def message(self) -> str:
        """The fact with its value, and its meaning for the result."""


class Lack(NamedTuple):
    """Weakness of a witness: a doubt about it, or something that it lacks.

    Attributes:
        reason: name of the weakness.
        without: the witness as it would be without the weakness.
    """

    reason: Reason
    without: Witness


@dataclass(frozen=True, eq=False)
class Witness:
    """Measurement of the scale by one ruler.

    Attributes:
        kind: kind of the ruler.
        gsd_m_per_px: its own scale, metres per pixel of the full image, at its centre in a tilted
            view; None if nothing was found.
        right: ``[g]`` density of the scale if it is right, without shared errors; None if none.
        chance_wrong: 0..1, chance that it measured something else and says nothing.
        sets_scale: whether it can set a scale; a prior cannot.
        assumed: whether it rests on a guess of the caller, neither found nor measured.
        shared: errors in common with other witnesses.
        guess: a guess of the caller about this measurement; None without one.
        lacks: weaknesses whose removal would raise its weight.
        n: number of things measured.
        statement: the measurement in a sentence; None if not needed.
        marks: measured lines, for pictures.
        notices: warnings; without a scale they give the cause.
    """

    kind: str
    gsd_m_per_px: float | None = None
    right: Density | None = None
    chance_wrong: float = 0.0
    sets_scale: bool = True
    assumed: bool = False
    shared: tuple[Shared, ...] = ()
    guess: Witness | None = None
    lacks: tuple[Lack, ...] = ()
    n: int = 1
    statement: str | None = None
    marks: tuple[Mark, ...] = ()
    notices: tuple[Remark, ...] = ()

    @property
    def found(self) -> bool:
        """Whether the ruler found something."""
        return self.right is not None

    @cached_property
    def density(self) -> Density:
        """Density ``[g]`` of the scale by this witness alone; flat if nothing was found."""
        if self.right is None:
            return flat()
        if self.guess is None:
            return self.factor(self.shared)
        return _Posterior([self]).density

    @cached_property
    def right_with_guess(self) -> Density | None:
        """Density ``[g]`` as ``right``, narrowed by the guess."""
        if self.right is None or self.guess is None:
            return self.right
        return product(self.right, self.guess.density)

    @property
    def interval(self) -> Interval | None:
        """95 % interval if the witness is right, metres per pixel; None if nothing was found.

        The interval includes the shared errors, and is extended to the witness's own scale.
        """
        if self.right_with_guess is None or self.gsd_m_per_px is None:
            return None
        low, high = credible_interval(blurred_by(self.right_with_guess, self.shared))
        return Interval(min(low, self.gsd_m_per_px), max(high, self.gsd_m_per_px))

    def allows(self, gsd_m_per_px: float) -> bool:
        """Test whether a scale lies in the 95 % interval."""
        interval = self.interval
        return interval is not None and interval.low <= gsd_m_per_px <= interval.high

    def factor(self, errors: Sequence[Shared]) -> Density:
        """Compute the factor ``[g]`` of the posterior.

        Args:
            errors: shared errors to include, those of this witness alone. Errors of a group are
                included once, in the product of the group.
        """
        return with_errors(self._own_factor, errors)

    def factor_if_wrong(self, errors: Sequence[Shared]) -> Density:
        """Compute the part ``[g]`` of the factor in which the witness is wrong.

        Args:
            errors: as in ``factor``.
        """
        factor = self._own_factor
        # The floor supports all scales alike, and therefore says nothing.
        floor = np.full_like(factor, blurred_by(factor, errors).min())
        return with_errors(floor, errors, whole=factor)

    @property
    def _own_factor(self) -> Density:
        """Factor ``[g]`` of the posterior without errors."""
        assert self.right is not None
        return self.right * (1.0 - self.chance_wrong) + flat() * self.chance_wrong


def with_shared_error(witness: Witness, error: Shared, *, removes: Reason) -> Witness:
    """Add a shared error to a witness and its guess, and the lack whose removal takes it away.

    Args:
        witness: a witness that found something.
        error: the error; it also applies to the witness without its other lacks.
        removes: name of the lack. A lack of this name is replaced.
    """
    lacks = []
    for lack in witness.lacks:
        if lack.reason == removes:
            continue
        lacks.append(Lack(lack.reason, _sharing(lack.without, error)))
    lacks.append(Lack(removes, witness))
    return replace(_sharing(witness, error), lacks=tuple(lacks))


def _sharing(witness: Witness, error: Shared) -> Witness:
    """Add a shared error to a witness and its guess."""
    guess = witness.guess
    if guess is not None:
        guess = replace(guess, shared=(*guess.shared, error))
    return replace(witness, shared=(*witness.shared, error), guess=guess)


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
        leading: index of the probably right setting witness without which the interval is widest.
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
    posterior = _Posterior(witnesses)
    p_right = []
    answers_without = []
    for k in range(len(witnesses)):
        # P(witness k is right | all witnesses) is one minus the part in which it is wrong, and the
        # part in which an error of it is large: its own scale is wrong, too.
        if_right = posterior.density - posterior.part_if_wrong([k])
        p_usual = float((if_right * _share_of_usual_errors(witnesses[k])).sum())
        p_right.append(max(0.0, p_usual))
        answers_without.append(judge(_all_but(witnesses, k)))
    contradictions = _contradictions(witnesses, p_right)
    chance = decision.chance
    for pair in contradictions:
        chance = min(chance, _chance_between(witnesses, p_right, pair, decision.gsd_m_per_px))
    reason: Reason | None = None
    if not decision.usable:
        reason = _weakness(witnesses, answers_without, chance)
    elif chance < USABLE_CHANCE:
        reason = "disagree"
    decision = replace(decision, chance=chance)
    # A compromise between witnesses that exclude each other is no more exact than they are apart.
    intervals = [witnesses[k].interval for pair in contradictions for k in pair]
    return replace(
        decision,
        interval=decision.interval.with_others(intervals),
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
    posterior = _Posterior(witnesses)

    # A scale needs a setting witness that is right. The part of the posterior in which none is
    # right comes from priors and flat densities: it would draw the median towards the middle of
    # the grid. It therefore counts in the chance, but not in the value.
    unsupported = posterior.part_if_wrong(setting)
    supported = normalised(np.maximum(posterior.density - unsupported, 0.0) + MIN_PROBABILITY)
    value = quantile(supported, 0.5)
    chance = mass_within(posterior.density, value)
    if any(_is_of_caller(witness) for witness in witnesses):
        confirmed = _facts_confirmed_by_priors(witnesses, posterior)
        chance -= max(0.0, mass_within(confirmed, value))
    return Answer(
        value,
        interval=credible_interval(supported),
        chance=min(chance, MAX_CHANCE, _ceiling_of_contradiction(witnesses, value)),
        density=supported,
        posterior=posterior.density,
    )


def _ceiling_of_contradiction(witnesses: Sequence[Witness], gsd_m_per_px: float) -> float:
    """Compute the largest chance of a scale that stated facts set against what is seen.

    In the product only ratios count: a line that is right with 0.93 wins against cars that are
    right with 0.4, at a chance of 0.95. But how often callers and files are wrong is a choice, and
    a fact that is contradicted is more often wrong than others. The ceiling is the chance that what
    is seen is wrong, as far as it excludes the scale: cars that are a tenth off hardly lower it.

    Args:
        witnesses: those that found something.
        gsd_m_per_px: the scale by all of them.
    """
    # A guess about the cars' length is stated, too.
    seen = [replace(witness, guess=None) for witness in witnesses if not _is_stated(witness)]
    if len(seen) == len(witnesses):
        return 1.0
    by_sight = judge(seen)
    if by_sight is None:
        return 1.0
    chance_here = mass_within(by_sight.posterior, gsd_m_per_px)
    excluded_share = max(0.0, 1.0 - chance_here / by_sight.chance)
    return 1.0 - by_sight.chance * math.pow(excluded_share, CONTRADICTION_POWER)


def _is_stated(witness: Witness) -> bool:
    """Test whether a witness rests on a statement of the caller or of the file."""
    return any(error.name in (MEASURING.name, FILE.name) for error in witness.shared)


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


def _facts_confirmed_by_priors(witnesses: Sequence[Witness], posterior: _Posterior) -> Density:
    """Compute the mass ``[g]`` that facts of the caller gain because a prior agrees with them.

    A prior may narrow such a fact, but not confirm it: it does not tell a scale from one 1.5 times
    as large. The mass is the difference, with and without priors, of the part in which all that the
    product found is wrong.
    """
    without_priors = [witness for witness in witnesses if witness.sets_scale]
    alone = _Posterior(without_priors).part_if_wrong(_found_by_product(without_priors))
    return posterior.part_if_wrong(_found_by_product(witnesses)) - alone


def _found_by_product(witnesses: Sequence[Witness]) -> list[int]:
    """List the indices of the setting witnesses that do not rest on a fact of the caller."""
    return [k for k, w in enumerate(witnesses) if w.sets_scale and not _is_of_caller(w)]


def _is_of_caller(witness: Witness) -> bool:
    """Test whether a witness rests on a guess or a measurement of the caller."""
    return witness.assumed or any(error.name == MEASURING.name for error in witness.shared)


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
    excluding = []
    for first, second in combinations(setting, 2):
        if _exclude_each_other(witnesses[first], witnesses[second]):
            excluding.append((first, second))
    return tuple(excluding)


def _chance_between(
    witnesses: Sequence[Witness], p_right: Sequence[float], pair: tuple[int, int], gsd: float
) -> float:
    """Compute the largest chance of a scale by two witnesses that exclude each other.

    In the product both can be right, one by a large error. More likely only one is: then the chance
    is the share of those that are within 20 % of the scale.
    """
    p_near = 0.0
    for k in pair:
        own_gsd = witnesses[k].gsd_m_per_px
        if own_gsd and abs(gsd / own_gsd - 1) <= TOLERANCE:
            p_near += p_right[k]
    return p_near / sum(p_right[k] for k in pair)


def _exclude_each_other(first: Witness, second: Witness) -> bool:
    """Test whether the scale of each of two witnesses lies outside the other's 95 % interval."""
    if first.gsd_m_per_px is None or second.gsd_m_per_px is None:
        return False
    return not (first.allows(second.gsd_m_per_px) or second.allows(first.gsd_m_per_px))


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
        remedied: list[tuple[Reason, Answer | None]] = []
        for lack in witness.lacks:
            without_lack = judge([*others, lack.without])
            remedied.append((lack.reason, without_lack))
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


class _Posterior:
    """Product of the factors of all witnesses.

    Attributes:
        density: ``[g]`` probabilities, their sum 1.
    """

    def __init__(self, witnesses: Sequence[Witness]) -> None:
        self._cases = _cases(dict(enumerate(witnesses)))
        log_product = self._log_product(wrong=())
        # The largest cell becomes 1 before the exponential, so that no product underflows.
        self._log_peak = log_product.max()
        masses = np.exp(log_product - self._log_peak)
        self._total = masses.sum()
        self.density: Density = masses / self._total

    def part_if_wrong(self, wrong: Collection[int]) -> Density:
        """Compute the part ``[g]`` of the posterior in which these witnesses say nothing.

        It has the posterior's normalisation: its sum is the probability that all of them are wrong.

        Args:
            wrong: indices of the witnesses.
        """
        masses = np.exp(self._log_product(wrong) - self._log_peak)
        return np.asarray(masses / self._total)

    def _log_product(self, wrong: Collection[int]) -> Density:
        guesses = [_index_of_guess(k) for k in wrong]
        logs = []
        for case in self._cases:
            log_product = case.log_product([*wrong, *guesses])
            logs.append(math.log(case.weight) + log_product)
        return np.asarray(np.logaddexp.reduce(logs, axis=0))


class _Case(NamedTuple):
    """Case of the posterior: each witness with a guess is right, or says nothing.

    Attributes:
        weight: factor on the product of the groups.
        groups: all witnesses of the case.
    """

    weight: float
    groups: Sequence[Group]

    def log_product(self, wrong: Collection[int]) -> Density:
        """Multiply the groups ``[g]`` relative to flat ones, of which cases have different numbers.

        Args:
            wrong: indices of the witnesses that say nothing.
        """
        logs = []
        for group in self.groups:
            density = np.maximum(group.density(wrong), MIN_PROBABILITY)
            logs.append(np.log(density / flat()))
        return np.asarray(np.sum(logs, axis=0))


def _cases(witnesses: Mapping[int, Witness]) -> list[_Case]:
    """Split the posterior into cases: a guess counts only if the witness that needs it is right.

    Args:
        witnesses: by index.
    """
    for k, witness in witnesses.items():
        if witness.guess is not None:
            return _cases_of_guess(witnesses, k)
    return [_Case(1.0, group_by_shared_errors(witnesses))]


def _cases_of_guess(witnesses: Mapping[int, Witness], k: int) -> list[_Case]:
    """Split the posterior into the cases that the witness ``k`` is right, and that it is wrong."""
    witness = witnesses[k]
    assert witness.guess is not None
    # The floor of the factor is the case that it says nothing.
    factor = witness.factor(())
    floor = factor.min()
    chance_wrong = float(floor * len(factor))
    above_floor = np.maximum(factor - floor, 0.0)
    cases = []
    if above_floor.any():
        alone = replace(witness, right=normalised(above_floor), chance_wrong=0.0, guess=None)
        pair = {k: alone, _index_of_guess(k): witness.guess}
        # The guess narrows this case. If it agrees, it does not make the case more likely.
        pair_alone = _Case(1.0, group_by_shared_errors(pair))
        agreement = float(np.exp(pair_alone.log_product(())).mean())
        weight = (1.0 - chance_wrong) / max(1.0, agreement)
        cases += _weighted(_cases({**witnesses, **pair}), weight)
    if chance_wrong > 0.0:
        says_nothing = replace(witness, right=flat(), chance_wrong=0.0, guess=None)
        cases += _weighted(_cases({**witnesses, k: says_nothing}), chance_wrong)
    return cases


def _weighted(cases: Iterable[_Case], factor: float) -> list[_Case]:
    """Multiply the weights of cases by a factor."""
    return [case._replace(weight=case.weight * factor) for case in cases]


def _index_of_guess(k: int) -> int:
    """Return the index of the guess of the witness ``k``: negative, unlike that of a witness."""
    return -1 - k
