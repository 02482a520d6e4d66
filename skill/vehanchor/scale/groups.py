"""Groups of witnesses that share errors, and their factors of the posterior.

Groups are nested: an error acts on the witnesses that have it, and on no others. Look-alikes make
the vehicles and the prior wrong, but not a line that shares another error with both.
"""

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


class _Single(NamedTuple):
    """Witness with the errors that it alone has.

    Attributes:
        number: its index.
        factor: ``[g]`` its factor.
        if_wrong: ``[g]`` part of the factor in which it is wrong.
    """

    number: int
    factor: Density
    if_wrong: Density

    @property
    def indices(self) -> frozenset[int]:
        """Its index."""
        return frozenset({self.number})

    def density(self, wrong: Collection[int]) -> Density:
        """Return the factor ``[g]``, or of a wrong witness the part in which it is wrong."""
        return self.if_wrong if self.number in wrong else self.factor


class Group(NamedTuple):
    """Witnesses with common errors, and groups inside whose witnesses share further errors.

    Attributes:
        parts: the single witnesses and the groups inside.
        common: errors that all of them have, by name.
    """

    parts: Sequence[_Single | Group]
    common: Mapping[str, Shared]

    @property
    def indices(self) -> frozenset[int]:
        """Indices of all its witnesses."""
        return frozenset[int]().union(*(part.indices for part in self.parts))

    def density(self, wrong: Collection[int]) -> Density:
        """Compute the group's factor ``[g]`` of the posterior.

        Args:
            wrong: indices of witnesses of which only the part is used in which they are wrong.
        """
        used = [part.density(wrong) for part in self.parts]
        if len(used) == 1:
            return used[0]
        # The whole product scales the part, so that the part stays below the whole.
        factors = [part.density(()) for part in self.parts]
        used_share = _share(used, factors)
        whole = _share(factors, factors)
        return with_errors(used_share, tuple(self.common.values()), whole=whole)


def _share(used: Sequence[Density], whole: Sequence[Density]) -> Density:
    """Compute the part ``[g]`` of a product in which some factors are replaced by smaller ones.

    Args:
        used: the factors, some of them replaced.
        whole: all factors; their product has the sum 1.
    """
    total = float(np.prod(whole, axis=0).sum())
    if total > 0.0:
        return np.asarray(np.prod(used, axis=0) / total)
    return _share_with_floors(used, whole)


def _share_with_floors(used: Sequence[Density], whole: Sequence[Density]) -> Density:
    """Compute the part ``[g]`` of a product in which some factors are used by their floor alone.

    Factors that exclude each other have no scale in common: the product underflows. With a floor
    under each of them, their logs show which scales contradict the fewest factors.

    Args:
        used: the factors, some of them replaced by their floor.
        whole: all factors; their product, with floors, has the sum 1.
    """
    log_used = _floored_log_product(used)
    log_whole = _floored_log_product(whole)
    # The largest cell becomes 1 before the exponential, so that no product underflows.
    log_peak = log_whole.max()
    total = np.exp(log_whole - log_peak).sum()
    return np.asarray(np.exp(log_used - log_peak) / total)


def _floored_log_product(factors: Sequence[Density]) -> Density:
    """Compute the log of the product ``[g]`` of factors with a floor under each of them."""
    logs = [np.log(np.maximum(factor, MIN_PROBABILITY)) for factor in factors]
    return np.asarray(np.sum(logs, axis=0))


class _Cluster(NamedTuple):
    """Witnesses that have the same errors in common.

    Attributes:
        indices: the witnesses.
        errors: by name.
    """

    indices: frozenset[int]
    errors: Mapping[str, Shared]

    def crosses(self, other: _Cluster) -> bool:
        """Test whether two clusters have witnesses in common, and neither is a part of the other.

        Two clusters of the same witnesses count as crossing.
        """
        if self.indices.isdisjoint(other.indices):
            return False
        return not (self.indices < other.indices or other.indices < self.indices)


def group_by_shared_errors(witnesses: Mapping[int, Member]) -> list[Group]:
    """Group witnesses, by index, that share errors; a witness without any is a group of its own."""
    n_sharing: Counter[str] = Counter()
    for witness in witnesses.values():
        n_sharing.update({error.name for error in witness.shared})
    parts: list[_Single | Group] = []
    for k, witness in witnesses.items():
        own = [error for error in witness.shared if n_sharing[error.name] == 1]
        parts.append(_Single(k, witness.factor(own), witness.factor_if_wrong(own)))

    # Small groups become parts of the larger ones around them.
    for cluster in _clusters(witnesses):
        inside = [part for part in parts if part.indices <= cluster.indices]
        parts = [part for part in parts if not part.indices <= cluster.indices]
        parts.append(Group(inside, cluster.errors))
    return [part if isinstance(part, Group) else Group([part], {}) for part in parts]


def _clusters(witnesses: Mapping[int, Member]) -> list[_Cluster]:
    """Collect the errors that witnesses have in common, those of the fewest witnesses first.

    Of two clusters, one contains the other, or they have no witness in common.
    """
    by_name: dict[str, _Cluster] = {}
    for k, witness in witnesses.items():
        for error in witness.shared:
            alone = _Cluster(frozenset({k}), {error.name: error})
            by_name[error.name] = _merged(by_name.get(error.name, alone), alone)
    clusters: list[_Cluster] = []
    for cluster in by_name.values():
        if len(cluster.indices) > 1:
            clusters = _with_cluster(clusters, cluster)
    return sorted(clusters, key=lambda cluster: len(cluster.indices))


def _with_cluster(clusters: Sequence[_Cluster], cluster: _Cluster) -> list[_Cluster]:
    """Add a cluster; it becomes one with those that it crosses."""
    crossing = [other for other in clusters if other.crosses(cluster)]
    if not crossing:
        return [*clusters, cluster]
    apart = [other for other in clusters if not other.crosses(cluster)]
    for other in crossing:
        cluster = _merged(cluster, other)
    return _with_cluster(apart, cluster)


def _merged(first: _Cluster, second: _Cluster) -> _Cluster:
    """Make one cluster of two; of two sizes of one error, the larger is used."""
    errors = dict(first.errors)
    for name, error in second.errors.items():
        same = errors.get(name, error)
        sizes = zip(error[1:], same[1:], strict=True)
        errors[name] = Shared(name, *(max(pair) for pair in sizes))
    return _Cluster(first.indices | second.indices, errors)
