"""Advice for each reason why a scale is not usable: the problem and a remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.records import Reason


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        helps: the remedy, a clause in the imperative.
    """

    why: str
    helps: str


ADVICE: Mapping[Reason, Advice] = {
    "too_coarse": Advice("the vehicles have too little detail", "fly lower, or send the full-resolution image"),
    "too_few": Advice("too little evidence", "include more cars: fly higher, or over streets and car parks"),
    "not_cars": Advice("the vehicles may not be cars", "look at the overlay, or give a known length or the height"),
    "disagree": Advice(
        "sizes or rulers contradict each other", "look at the overlay, or give a known length or the height"
    ),
    "lost": Advice(
        "the scene is unlike the training data", "photograph streets or houses, or give the height above ground"
    ),
    "imprecise": Advice("the interval is too wide", "give a known length, or include cars"),
}
"""Advice by the ``reason`` of a record."""
