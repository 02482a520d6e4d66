"""Advice for photographs and components of a flight without a usable scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records.text import Advice, advice_for

if TYPE_CHECKING:
    from vehanchor.records import GsdEstimate


def component_advice(pooled: GsdEstimate, *, unlinked: bool) -> str | None:
    """Give the advice for a component; None if its scale is usable.

    Args:
        pooled: its scale.
        unlinked: whether it is a single photograph of a flight with more.
    """
    advice = advice_for(pooled)
    if advice is None:
        return None
    if unlinked:
        advice = Advice(
            f"{advice.why}, and no other photograph overlaps it", f"{advice.helps}; or fly with more overlap"
        )
    return _sentence(advice)


def carried_advice(*, maybe_tilted: bool) -> str:
    """Give the advice for a photograph whose scale comes from another one, with too wide an interval.

    Args:
        maybe_tilted: whether the ratios of the scales may be those of a tilted camera.
    """
    if maybe_tilted:
        return _sentence(
            Advice(
                "the overlaps fit a tilted camera as well as one that climbs",
                "give photographs with the camera's angle in their metadata, or taken straight down",
            )
        )
    return _sentence(
        Advice(
            "its rulers are in other photographs, and the overlaps in between widen the interval",
            "add photographs between them, or give the height",
        )
    )


def _sentence(advice: Advice) -> str:
    return f"{advice.why[0].upper()}{advice.why[1:]}: {advice.helps}."
