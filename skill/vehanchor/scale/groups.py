"""Groups of witnesses that share errors, and their factors of the posterior."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vehanchor.scale.density import MIN_PROBABILITY
from vehanchor.scale.reliability import Shared
from vehanchor.scale.shared_errors import with_errors

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from vehanchor.scale.density import Density


class Member(Protocol):
    """Witness as a member of a group."""

    @property
    def shared(self) -> tuple[Shared, ...]:
        """Errors in common with other witnesses."""

    def factor(self, errors: Sequence[Shared]) -> Density:
        """Compute the factor ``[g]`` of the posterior, with these errors."""

    def factor_if_wrong(self, errors: Sequence[Shared]) -> Density:
        """Compute the part ``[g]`` of the factor in which the witness is wrong."""


class Group(NamedTuple):
    """Witnesses that are linked by shared errors; a witness without any is a group of its own.

    Attributes:
        factors: ``[g]`` factor of each member by its index, with the errors of that member alone.
        if_wrong: ``[g]`` part of each factor in which the member is wrong.
        common: errors of two or more members, by name.
    """

    factors: Mapping[int, Density]
    if_wrong: Mapping[int, Density]
    common: Mapping[str, Shared]

    def density(self, wrong: Collection[int]) -> Density:
        """Compute the group's factor ``[g]`` of the posterior.

        Args:
            wrong: indices of witnesses of which only the part is used in which they are wrong.
        """
        used = []
        for k, factor in self.factors.items():
            used.append(self.if_wrong[k] if k in wrong else factor)
        if len(used) == 1:
            return used[0]
        # The whole product scales the part, so that the part stays below the whole.
        factors = list(self.factors.values())
        part = _part(used, factors)
        whole = _part(factors, factors)
        return with_errors(part, tuple(self.common.values()), whole=whole)


def _part(used: Sequence[Density], whole: Sequence[Density]) -> Density:
    """Compute the part ``[g]`` of a product in which some factors are replaced by smaller ones.

    Args:
        used: the factors, some of them replaced.
        whole: all factors; their product has the sum 1.
    """
    total = float(np.prod(whole, axis=0).sum())
    if total > 0.0:
        return np.asarray(np.prod(used, axis=0) / total)
    return _part_with_floors(used, whole)


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


def group_by_shared_errors(witnesses: Mapping[int, Member]) -> list[Group]:
    """Group witnesses, by index, that share an error, directly or through others."""
    n_sharing: Counter[str] = Counter()
    for witness in witnesses.values():
        n_sharing.update({error.name for error in witness.shared})

    groups: list[Group] = []
    for k, witness in witnesses.items():
        own = [error for error in witness.shared if n_sharing[error.name] == 1]
        common = {error.name: error for error in witness.shared if n_sharing[error.name] > 1}
        factors = {k: witness.factor(own)}
        if_wrong = {k: witness.factor_if_wrong(own)}
        # A witness can link groups that had nothing in common before: they become one.
        names = set(common)
        linked = [group for group in groups if not names.isdisjoint(group.common)]
        groups = [group for group in groups if names.isdisjoint(group.common)]
        for group in linked:
            factors = {**group.factors, **factors}
            if_wrong = {**group.if_wrong, **if_wrong}
            common = _larger_errors(common, group.common)
        groups.append(Group(factors, if_wrong, common=common))
    return groups


def _larger_errors(first: Mapping[str, Shared], second: Mapping[str, Shared]) -> dict[str, Shared]:
    """Merge errors by name; of two sizes of one error, the larger is used."""
    merged = dict(first)
    for name, error in second.items():
        same = merged.get(name, error)
        sizes = zip(error[1:], same[1:], strict=True)
        merged[name] = Shared(name, *(max(pair) for pair in sizes))
    return merged
