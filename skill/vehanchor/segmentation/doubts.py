"""Notices about doubtful masks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.imagery.raster import outer_sides
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.segmentation.shape import mask_pieces, touches_edge

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.raster import Raster
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard

SMALL_TARGET_PX = 15.0  # smallest side of the objects on which the bundled segmenter was evaluated
_OUTSIDE_SHARE = 0.10  # of the mask; a box that is 5 % off on one side leaves about as much outside


def mask_notices(
    raster: Raster, found: Segmentation, prompt: Prompt, card: SegmenterCard, width_px: float
) -> Iterator[Notice]:
    """List the doubts about a mask that concern its area."""
    pieces = mask_pieces(found.mask)
    if not len(pieces):
        yield Notice(
            code=NoticeCode.MASK_EMPTY,
            message="The segmenter found no object here: there is nothing to measure. Give a "
            "tighter box, or a point "
            "on the object.",
        )
        return
    if not found.is_agreed:
        yield Notice(
            code=NoticeCode.EXTENT_UNKNOWN,
            message="The masks that fit differ. This one may be a part of the object, or more: "
            "look at the outline, or "
            "draw a box around the object; this mask's own box adds nothing.",
        )
    if found.score < card.min_score:
        yield Notice(
            code=NoticeCode.MASK_SCORE_LOW,
            message=f"The expected overlap with the object is {found.score:.2f}, below "
            f"{card.min_score:g}. Look at the "
            "outline before using the area.",
        )
    if touches_edge(found.mask, outer_sides(found.window, raster.width_px, raster.height_px)):
        message = "The mask reaches the image's edge: the area is a lower bound."
        yield Notice(code=NoticeCode.MASK_TOUCHES_EDGE, message=message)
    outside = _share_outside(found, prompt)
    if outside > _OUTSIDE_SHARE:
        yield Notice(
            code=NoticeCode.MASK_LEAVES_BOX,
            message=f"{100 * outside:.0f} % of the mask lies outside the box: the box cuts the "
            "object, or the mask "
            "took in its surroundings.",
        )
    if len(pieces) > 1:
        largest = int(100 * pieces[0] / pieces.sum())
        yield Notice(
            code=NoticeCode.MASK_IN_PIECES,
            message=f"The mask has {len(pieces)} separate pieces; the largest is {largest} % of "
            "it. All of them count "
            "towards the area.",
        )
    if width_px < SMALL_TARGET_PX:
        yield Notice(
            code=NoticeCode.TARGET_SMALL,
            message=f"The object is {width_px:.1f} px wide: below {SMALL_TARGET_PX:g} px masks "
            "are less exact than the "
            "interval says. Use a larger copy of the image where there is one.",
        )


def _share_outside(found: Segmentation, prompt: Prompt) -> float:
    """Compute the share of the mask's pixels whose centres lie outside the box; 0 without a box."""
    if prompt.box is None:
        return 0.0
    x1, y1, x2, y2 = (
        max(0, round(at - origin))
        for at, origin in zip(prompt.box, (found.window.x_px, found.window.y_px) * 2, strict=True)
    )
    total = int(found.mask.sum())
    return 1.0 - int(found.mask[y1:y2, x1:x2].sum()) / total if total else 0.0
