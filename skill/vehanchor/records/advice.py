"""Advice for each reason why a scale is not usable: the problem and a remedy."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.records import GsdEstimate, Reason


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
    "stretched": Advice("the image is stretched in one direction", "send the original image, or keep its aspect ratio"),
    "disagree": Advice(
        "sizes or rulers contradict each other", "look at the overlay, or give a measured length or height"
    ),
    "lost": Advice(
        "the scene is unlike the training data", "photograph streets or houses, or give the height above ground"
    ),
    "imprecise": Advice("the interval is too wide", "give a known length, or include cars"),
    "assumed": Advice("it rests on one assumed fact", "say that it is measured, if it is, or give a second fact"),
}
"""Advice by the ``reason`` of a record."""

_MORE_CARS: frozenset[Reason] = frozenset({"too_few", "imprecise"})
_WITHOUT_SEARCH = "also use the ruler vehicles, or give a known length or the height"


def advice_for(estimate: GsdEstimate | None) -> Advice | None:
    """Give the advice for a record; None without one and for a usable scale.

    Without a search more cars would not help; the advice is to allow one.
    """
    if estimate is None or estimate.reason is None:
        return None
    advice = ADVICE[estimate.reason]
    searched = estimate.stopped_because is not None or estimate.n_detections > 0
    return advice if searched or estimate.reason not in _MORE_CARS else advice._replace(helps=_WITHOUT_SEARCH)
