"""Witnesses of the scale, and the joint posterior of several: the product of their factors.

``vehanchor.scale.posterior`` states the rule, and takes the answer from this density.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vehanchor.scale.density import (
    MIN_PROBABILITY,
    credible_interval,
    flat,
    normalised,
    product,
)
from vehanchor.scale.lengths import Interval
from vehanchor.scale.shared_errors import blurred_by, larger_errors, with_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from vehanchor.scale.defaults import Reason
    from vehanchor.scale.density import Density
    from vehanchor.scale.reliability import Shared


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
        right: ``[g]`` density of the scale if the witness is right, without shared errors; None
            if nothing was found.
        chance_wrong: 0..1, chance that it measured something else and says nothing.
        sets_scale: whether it can set a scale; a prior cannot.
        assumed: whether it rests on a guess of the caller, neither found in the picture nor
            measured.
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
        return JointPosterior([self]).density

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

    def factor(self, errors: Sequence[Shared]) -> Density:
        """Compute the factor ``[g]`` of the posterior.

        Args:
            errors: shared errors to include, those of this witness alone. Errors of a group are
                included once, in the product of the group.
        """
        assert self.right is not None
        factor = self.right * (1.0 - self.chance_wrong) + flat() * self.chance_wrong
        return with_errors(factor, errors)


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


class JointPosterior:
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
            logs.append(math.log(case.weight) + case.log_product([*wrong, *guesses]))
        return np.asarray(np.logaddexp.reduce(logs, axis=0))


class _Case(NamedTuple):
    """Case of the posterior: each witness with a guess is right, or says nothing.

    Attributes:
        weight: factor on the product of the groups.
        groups: all witnesses of the case.
    """

    weight: float
    groups: Sequence[_Group]

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
    return [_Case(1.0, _group_by_shared_errors(witnesses))]


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
        pair_alone = _Case(1.0, _group_by_shared_errors(pair))
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


class _Group(NamedTuple):
    """Witnesses that are linked by shared errors; a witness without any is a group of its own.

    Attributes:
        factors: ``[g]`` factor of each member by its index, with the errors of that member alone.
        common: errors of two or more members, by name.
    """

    factors: Mapping[int, Density]
    common: Mapping[str, Shared]

    def density(self, wrong: Collection[int]) -> Density:
        """Compute the group's factor ``[g]`` of the posterior.

        Args:
            wrong: indices of witnesses of which only the part that says nothing is used: the floor
                of their factor, which supports all scales alike.
        """
        used = []
        for k, factor in self.factors.items():
            if k in wrong:
                factor = np.full_like(factor, factor.min())
            used.append(factor)
        if len(used) == 1:
            return used[0]
        # The whole product scales the part, so that the part stays below the whole.
        whole = list(self.factors.values())
        total = float(np.prod(whole, axis=0).sum())
        if total > 0.0:
            part = np.prod(used, axis=0) / total
        else:
            part = _part_with_floors(used, whole)
        return with_errors(part, tuple(self.common.values()))


def _part_with_floors(used: Sequence[Density], whole: Sequence[Density]) -> Density:
    """Compute the part ``[g]`` of a product in which some factors are used by their floor alone.

    Factors that exclude each other have no scale in common: the product underflows. With a floor
    under each of them, their logs show which scales contradict the fewest factors.

    Args:
        used: the factors, some of them replaced by their floor.
        whole: all factors; their product, with floors, has the sum 1.
    """
    log_part = np.sum([np.log(np.maximum(factor, MIN_PROBABILITY)) for factor in used], axis=0)
    log_whole = np.sum([np.log(np.maximum(factor, MIN_PROBABILITY)) for factor in whole], axis=0)
    # The largest cell becomes 1 before the exponential, so that no product underflows.
    log_peak = log_whole.max()
    return np.asarray(np.exp(log_part - log_peak) / np.exp(log_whole - log_peak).sum())


def _group_by_shared_errors(witnesses: Mapping[int, Witness]) -> list[_Group]:
    """Group witnesses, by index, that share an error, directly or through others."""
    n_sharing: Counter[str] = Counter()
    for witness in witnesses.values():
        n_sharing.update({error.name for error in witness.shared})

    groups: list[_Group] = []
    for k, witness in witnesses.items():
        own = [error for error in witness.shared if n_sharing[error.name] == 1]
        common = {error.name: error for error in witness.shared if n_sharing[error.name] > 1}
        factors = {k: witness.factor(own)}
        # A witness can link groups that had nothing in common before: they become one.
        names = set(common)
        linked = [group for group in groups if not names.isdisjoint(group.common)]
        groups = [group for group in groups if names.isdisjoint(group.common)]
        for group in linked:
            factors = {**group.factors, **factors}
            common = larger_errors(common, group.common)
        groups.append(_Group(factors, common))
    return groups
