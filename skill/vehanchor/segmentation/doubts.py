"""Notices about doubtful masks."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.imagery.raster import outer_sides
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.lengths import Z95
from vehanchor.segmentation.shape import piece_areas_px, touches_edge

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.raster import Raster
    from vehanchor.segmentation.object_mask import ObjectMask
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard

# Smallest side of the objects on which the bundled segmenter was evaluated.
SMALL_TARGET_PX = 15.0
# Share of the mask. A box that is 5 % off on one side leaves about as much outside.
_MAX_OUTSIDE_SHARE = 0.10


def mask_notices(
    raster: Raster,
    segmentation: Segmentation,
    *,
    prompt: Prompt,
    card: SegmenterCard,
    width_px: float,
) -> Iterator[Notice]:
    """List the doubts about a mask that concern its area.

    Args:
        raster: the image.
        segmentation: the mask.
        prompt: prompt of the mask.
        card: model card of the segmenter.
        width_px: width of the smallest rotated rectangle around the mask.
    """
    piece_areas = piece_areas_px(segmentation.mask)
    if not len(piece_areas):
        yield Notice(
            code=NoticeCode.MASK_EMPTY,
            message="The segmenter found no object here, so there is nothing to measure. Give a "
            "tighter box, or a point on the object.",
        )
        return
    if not segmentation.is_agreed:
        yield Notice(
            code=NoticeCode.EXTENT_UNKNOWN,
            message="The masks that fit differ. This one may be a part of the object, or more: "
            "look at the outline, or draw a box around the object; this mask's own box adds "
            "nothing.",
        )
    if segmentation.score < card.min_score:
        yield Notice(
            code=NoticeCode.MASK_SCORE_LOW,
            message=f"The expected overlap with the object is {segmentation.score:.2f}, below "
            f"{card.min_score:g}. Look at the outline before using the area.",
        )
    if segmentation.depends_on_box:
        factor = math.exp(Z95 * segmentation.box_log_sd)
        yield Notice(
            code=NoticeCode.MASK_DEPENDS_ON_BOX,
            message=f"A box {segmentation.box_error_px:.2g} px wider or tighter changes the area "
            f"by a factor of up to {factor:.2g}. The object is small: draw the box in an enlarged "
            "copy, and give its size as the frame, or draw the outline as a polygon.",
        )
    yield from edge_notices(raster, segmentation)
    outside = _share_outside(segmentation, prompt)
    if outside > _MAX_OUTSIDE_SHARE:
        yield Notice(
            code=NoticeCode.MASK_LEAVES_BOX,
            message=f"{100 * outside:.0f} % of the mask lies outside the box: the box cuts the "
            "object, or the mask includes its surroundings.",
        )
    if len(piece_areas) > 1:
        largest = int(100 * piece_areas[0] / piece_areas.sum())
        yield Notice(
            code=NoticeCode.MASK_IN_PIECES,
            message=f"The mask has {len(piece_areas)} separate pieces; the largest is "
            f"{largest} % of it. All of them count towards the area.",
        )
    if width_px < SMALL_TARGET_PX:
        yield Notice(
            code=NoticeCode.TARGET_SMALL,
            message=f"The object is {width_px:.1f} px wide. Below {SMALL_TARGET_PX:g} px, masks "
            "are less exact than the interval states. Use a larger copy of the image if there is "
            "one.",
        )


def edge_notices(raster: Raster, pixels: ObjectMask) -> Iterator[Notice]:
    """State that a mask reaches the image's edge."""
    image_sides = outer_sides(pixels.window, raster.width_px, raster.height_px)
    if touches_edge(pixels.mask, image_sides):
        yield Notice(
            code=NoticeCode.MASK_TOUCHES_EDGE,
            message="The mask reaches the image's edge: the area is a lower bound.",
        )


def _share_outside(segmentation: Segmentation, prompt: Prompt) -> float:
    """Compute the share of the mask's pixels whose centres lie outside the box; 0 without a box."""
    if prompt.box is None:
        return 0.0
    total = int(segmentation.mask.sum())
    if total == 0:
        return 0.0
    x1, y1, x2, y2 = prompt.box
    origin_x = segmentation.window.x_px
    origin_y = segmentation.window.y_px
    columns = _pixels_between(x1 - origin_x, x2 - origin_x)
    rows = _pixels_between(y1 - origin_y, y2 - origin_y)
    inside = int(segmentation.mask[rows, columns].sum())
    return 1.0 - inside / total


def _pixels_between(start: float, stop: float) -> slice:
    """Select the pixels whose centres lie between two places of the mask's window."""
    return slice(max(0, round(start)), max(0, round(stop)))
