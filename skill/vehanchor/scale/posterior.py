"""From evidence to an answer by one rule: each witness of the scale measured what it thinks, or did not.

The posterior is the product over witnesses of ``(1 - c) right + c wrong``, in which c is the chance
that the witness is wrong. Witnesses with a common error (one lens, one height, one caller) form a
group: their product is blurred by the common error, and may be wrong as a whole. Value, interval,
chance and reason follow from this posterior alone:

* the value is the median, given that at least one witness who can set a scale is right;
* the interval is the central 95 % of the same distribution;
* the chance is the posterior's mass within 20 % of the value. A prior does not confirm what a
  caller assumes;
* the scale is usable if the chance is at least 0.9;
* the reason is the doubt or lack whose removal raises the chance most.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from vehanchor.scale.defaults import PROBABLY_RIGHT, USABLE_CHANCE
from vehanchor.scale.density import (
    LEAST_PROBABILITY,
    blurred,
    credible_interval,
    flat,
    mass_within,
    normalised,
    quantile,
)
from vehanchor.scale.lengths import Interval
from vehanchor.scale.reliability import MOST_SURE, Shared

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.scale.defaults import Reason

_LEAST_GAIN = 1e-6


class Mark(NamedTuple):
    """Measured line of a ruler, or a labelled place.

    Attributes:
        points: its corners, x and y in pixels of the image; a single point is a place.
        label: text beside its middle, as "60 m"; empty for none.
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
    """Doubt or lack of a witness.

    Attributes:
        reason: its name.
        without: the witness if the doubt were removed, or the lack filled.
    """

    reason: Reason
    without: Witness


@dataclass(frozen=True, eq=False)
class Witness:
    """Measurement of the scale by one ruler.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: its own scale, metres per pixel of the full image, at its centre in a tilted
            view; None if nothing was found.
        right: ``[g]`` density of the scale if it measured what it thinks, without shared errors;
            None if nothing was found.
        chance_wrong: 0..1, chance that it did not, and says nothing.
        sets_scale: whether it can set a scale; a prior cannot.
        assumed: whether it rests on a guess of the caller, neither found in the picture nor
            measured.
        shared: errors in common with other witnesses.
        lacks: what would raise its weight.
        n: number of things measured.
        said: the measurement in a sentence; None if not needed.
        marks: measured lines, for pictures.
        notices: warnings; without a scale they say why.
    """

    kind: str
    gsd_m_per_px: float | None = None
    right: NDArray[np.float64] | None = None
    chance_wrong: float = 0.0
    sets_scale: bool = True
    assumed: bool = False
    shared: tuple[Shared, ...] = ()
    lacks: tuple[Lack, ...] = ()
    n: int = 1
    said: str | None = None
    marks: tuple[Mark, ...] = ()
    notices: tuple[Remark, ...] = ()

    @property
    def found(self) -> bool:
        """Whether the ruler found something."""
        return self.right is not None

    @cached_property
    def density(self) -> NDArray[np.float64]:
        """``[g]`` density of the scale by this witness alone, with its shared errors; flat if nothing was found."""
        return flat() if self.right is None else self.factor(self.shared)

    @property
    def interval(self) -> Interval | None:
        """Its own 95 % interval if it is right, metres per pixel, extended to its scale; None if nothing was found."""
        if self.right is None or self.gsd_m_per_px is None:
            return None
        low, high = credible_interval(blurred(self.right, _log_sd(self.shared)))
        return Interval(min(low, self.gsd_m_per_px), max(high, self.gsd_m_per_px))

    def factor(self, shared: Sequence[Shared]) -> NDArray[np.float64]:
        """Compute the density ``[g]`` with some of the shared errors."""
        assert self.right is not None
        return _mixed(self.right * (1.0 - self.chance_wrong) + flat() * self.chance_wrong, shared)


def sharing(witness: Witness, error: Shared, removes: Reason) -> Witness:
    """Give a witness an error that it shares; its lack ``removes`` is the witness without that error."""
    lacks = [each for each in witness.lacks if each.reason != removes]
    kept = tuple(
        Lack(each.reason, replace(each.without, shared=(*each.without.shared, error)))
        for each in lacks
    )
    return replace(witness, shared=(*witness.shared, error), lacks=(*kept, Lack(removes, witness)))


@dataclass(frozen=True, eq=False)
class Answer:
    """Scale by all witnesses.

    Attributes:
        gsd_m_per_px: the value, metres per pixel.
        interval: 95 % interval, metres per pixel.
        chance: 0..1, chance of an error below 20 %.
        density: ``[g]`` posterior, given that at least one witness who can set a scale is right.
        p_right: by witness that found something, the chance that it is right; these do not add up
            to 1.
        leading: index of the setting witness without which the interval is widest, of those that
            are probably right.
        reason: why the scale is not usable; None if it is.
    """

    gsd_m_per_px: float
    interval: Interval
    chance: float
    density: NDArray[np.float64] = field(repr=False)
    p_right: tuple[float, ...] = ()
    leading: int = 0
    reason: Reason | None = None

    @property
    def usable(self) -> bool:
        """Whether a planner may act on the scale."""
        return self.chance >= USABLE_CHANCE


def answer(witnesses: Sequence[Witness]) -> Answer | None:
    """Decide on the scale.

    Args:
        witnesses: all that found something, and others, which change nothing.

    Returns:
        The answer; None without a witness that can set a scale.
    """
    heard = [each for each in witnesses if each.found]
    found = judged(heard)
    if found is None:
        return None
    _, *wrong = _posterior(heard, *((k,) for k in range(len(heard))))
    without = [judged([*heard[:k], *heard[k + 1 :]]) for k in range(len(heard))]
    widths = [
        math.inf if each is None else each.interval.high / each.interval.low for each in without
    ]
    p_right = tuple(max(0.0, 1.0 - float(each.sum())) for each in wrong)
    setting = [k for k, each in enumerate(heard) if each.sets_scale]
    return replace(
        found,
        p_right=p_right,
        leading=max(setting, key=lambda k: (p_right[k] >= PROBABLY_RIGHT, widths[k])),
        reason=None if found.usable else _reason(heard, without, found.chance),
    )


def judged(witnesses: Sequence[Witness]) -> Answer | None:
    """Compute value, interval and chance alone; see ``answer``."""
    heard = [each for each in witnesses if each.found]
    setting = [k for k, each in enumerate(heard) if each.sets_scale]
    if not setting:
        return None
    posterior, none_right = _posterior(heard, setting)
    confirmed = np.zeros_like(posterior)  # by priors alone
    if any(each.assumed for each in heard):
        confirmed = _guessed(heard) - _guessed([heard[k] for k in setting])
    given_any = normalised(np.maximum(posterior - none_right, 0.0) + LEAST_PROBABILITY)
    value = quantile(given_any, 0.5)
    # a prior only narrows a guess
    chance = mass_within(posterior, value) - max(0.0, mass_within(confirmed, value))
    return Answer(value, credible_interval(given_any), min(chance, MOST_SURE), given_any)


def _guessed(heard: Sequence[Witness]) -> NDArray[np.float64]:
    """Compute the part ``[g]`` of the posterior in which no witness that is found or measured is right."""
    known = [k for k, each in enumerate(heard) if each.sets_scale and not each.assumed]
    return _posterior(heard, known)[1]


def _reason(heard: Sequence[Witness], without: Sequence[Answer | None], chance: float) -> Reason:
    """Name the doubt, lack or contradiction whose removal raises the chance most."""
    gains: list[tuple[float, Reason]] = [(_LEAST_GAIN, "imprecise")]
    for k, each in enumerate(heard):
        others = [*heard[:k], *heard[k + 1 :]]
        better = [(lack.reason, judged([*others, lack.without])) for lack in each.lacks]
        gains += [
            (found.chance - chance, reason)
            for reason, found in (*better, ("disagree", without[k]))
            if found
        ]
    return max(gains, key=lambda each: each[0])[1]


def _posterior(
    heard: Sequence[Witness], *floored: Collection[int]
) -> tuple[NDArray[np.float64], ...]:
    """Multiply the factors of all witnesses.

    Returns:
        The posterior ``[g]``, and for each of ``floored`` the part in which these witnesses say
        nothing.
    """
    parts = _components(heard)
    logs = np.array(
        [
            np.sum(
                [np.log(np.maximum(each.density(floor), LEAST_PROBABILITY)) for each in parts],
                axis=0,
            )
            for floor in ((), *floored)
        ]
    )
    masses = np.exp(logs - logs[0].max())
    return tuple(masses / masses[0].sum())


class _Component(NamedTuple):
    """Witnesses that are linked by shared errors.

    Attributes:
        factors: ``[g]`` of each member by its index, with the errors of that member alone.
        common: errors of two or more members, by name.
    """

    factors: Mapping[int, NDArray[np.float64]]
    common: Mapping[str, Shared]

    def density(self, floored: Collection[int]) -> NDArray[np.float64]:
        """Compute the factor ``[g]``; of the members in ``floored`` only the part that says nothing is kept."""
        kept = [
            np.full_like(each, each.min()) if k in floored else each
            for k, each in self.factors.items()
        ]
        if len(kept) == 1:
            return kept[0]
        total = float(np.prod(list(self.factors.values()), axis=0).sum())
        return _mixed(np.prod(kept, axis=0) / total, tuple(self.common.values()))


def _components(heard: Sequence[Witness]) -> list[_Component]:
    """Group witnesses that share an error, directly or by others."""
    count = Counter(name for witness in heard for name in {each.name for each in witness.shared})
    groups: list[_Component] = []
    for k, witness in enumerate(heard):
        factors = {k: witness.factor([each for each in witness.shared if count[each.name] == 1])}
        common = {each.name: each for each in witness.shared if count[each.name] > 1}
        linked = [each for each in groups if each.common.keys() & common.keys()]
        groups = [each for each in groups if not each.common.keys() & common.keys()]
        for other in linked:
            factors = {**other.factors, **factors}
            for name, one in other.common.items():
                two = common.get(name, one)
                common[name] = Shared(
                    name, max(one.log_sd, two.log_sd), max(one.chance_wrong, two.chance_wrong)
                )
        groups.append(_Component(factors, common))
    return groups


def _mixed(density: NDArray[np.float64], shared: Sequence[Shared]) -> NDArray[np.float64]:
    """Blur a density ``[g]`` of any sum by errors, and mix it with the case that their causes make it wrong."""
    chance_right = math.prod(1.0 - each.chance_wrong for each in shared)
    return chance_right * blurred(density, _log_sd(shared)) + (1.0 - chance_right) * flat()


def _log_sd(shared: Sequence[Shared]) -> float:
    return math.hypot(*(each.log_sd for each in shared))
