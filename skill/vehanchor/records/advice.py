"""Words for each reason why a scale is not to be used: what is wrong, and what would help."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.records import Reason


class Advice(NamedTuple):
    """What to tell somebody whose scale is not to be used.

    Attributes:
        why: a clause without an end.
        helps: what would help, a clause in the imperative.
    """

    why: str
    helps: str


ADVICE: Mapping[Reason, Advice] = {
    "too_coarse": Advice(
        "vehicles show too little detail to be measured well", "fly lower, or send the full-resolution image"
    ),
    "too_few": Advice("too little evidence", "take in more cars: from higher up, or over streets and car parks"),
    "not_cars": Advice("the vehicles may not be cars", "look at the overlay, or give a known length or the height"),
    "disagree": Advice(
        "sizes or rulers contradict each other", "look at the overlay, or give a known length or the height"
    ),
    "lost": Advice(
        "the ground is like nothing of known scale", "look where streets or houses are, or give the height above ground"
    ),
    "imprecise": Advice("what was measured by leaves the scale too open", "give a known length, or take in cars"),
}
"""By the ``reason`` of a record."""
