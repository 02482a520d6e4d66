"""Merging of tiles: from objects in tile pixels to distinct objects in image pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.boxes import box_corners, oriented_nms
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.levels import SearchLevel
    from vehanchor.imagery.raster import Window


def objects_in_image(
    objects: Objects, window: Window, level: SearchLevel, overlap_px: int
) -> Objects:
    """Convert a tile's objects to pixels of the image, without those that its inner edges cut.

    The next tile shows these completely, unless they are longer than the overlap.

    Args:
        objects: objects in pixels of the tile.
        window: the tile, in pixels of the level's image.
        level: level of the tile.
        overlap_px: overlap of neighbouring tiles.
    """
    start = np.array([window.x_px, window.y_px])
    size = np.array([window.width_px, window.height_px])
    level_size = (level.width_px, level.height_px)
    # An edge of the tile is an inner edge if the level's image goes on behind it.
    corners = box_corners(objects.boxes)
    starts_inside = start > 0
    ends_inside = start + size < level_size
    is_cut_at_start = (corners.min(axis=1) < 1) & starts_inside
    is_cut_at_end = (corners.max(axis=1) > size - 1) & ends_inside
    is_cut = (is_cut_at_start | is_cut_at_end).any(axis=1)
    next_shows_it = objects.boxes[:, 2] < overlap_px
    whole = objects.take(~(is_cut & next_shows_it))
    boxes = whole.boxes.copy()
    boxes[:, :2] += start
    boxes[:, :4] *= level.factor
    return Objects(boxes, whole.scores, whole.classes)


def distinct_vehicles(vehicles: Objects, min_score: float, nms_iou: float) -> NDArray[np.intp]:
    """Suppress non-maximum vehicles; return the indices of the others, best first.

    Args:
        vehicles: vehicles of all tiles, in pixels of the image.
        min_score: vehicles with a lower score are left out.
        nms_iou: IoU above which two boxes are one vehicle.
    """
    certain = np.flatnonzero(vehicles.scores >= min_score)
    boxes = vehicles.boxes[certain]
    scores = vehicles.scores[certain]
    best = oriented_nms(boxes, scores, iou_threshold=nms_iou)
    return certain[best]


def distinct_by_class(objects: Objects, nms_iou: float) -> Objects:
    """Suppress non-maximum objects within each class; return the others, best first.

    Objects with equal scores are in the order of their classes.
    """
    parts = []
    for index in np.unique(objects.classes):
        members = objects.take(objects.classes == index)
        best = oriented_nms(members.boxes, members.scores, iou_threshold=nms_iou)
        parts.append(members.take(best))
    merged = Objects.joined(parts)
    best_first = np.argsort(-merged.scores, kind="stable")
    return merged.take(best_first)
