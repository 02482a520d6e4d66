"""Corrections of a search by the caller: vehicles that are dropped or added by hand."""

from __future__ import annotations

from dataclasses import astuple, replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.boxes import oriented_iou
from vehanchor.detection.detections import Corrections
from vehanchor.errors import InvalidParameterError
from vehanchor.scale.defaults import CAR_LENGTH_OVER_WIDTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.options import Frame
    from vehanchor.options.rulers import ByHand

_STATED_SCORE = 0.99  # the caller can be wrong, too
_POINTED_SD_PX = 2.0  # error of an end, in pixels where it was pointed at; our assumption


def corrected(
    detections: Detections, by_hand: ByHand, frame: Frame, size_px: tuple[int, int], nms_iou: float
) -> Detections:
    """Drop and add vehicles after a search.

    An added vehicle replaces the detections that it overlaps.

    Args:
        detections: result of the search, in pixels of the image.
        by_hand: the caller's corrections, in pixels of the frame, or of the image without a frame.
        frame: the caller's copy.
        size_px: width and height of the image.
        nms_iou: IoU above which two boxes are one vehicle.

    Returns:
        The detections with ``Detections.corrections``; the same ones without corrections.

    Raises:
        InvalidParameterError: a number does not exist, or two added vehicles are one.
    """
    if by_hand.given is None:
        return detections
    found = len(detections.boxes)
    missing = [each for each in by_hand.drop if each > found]
    if missing:
        have = f"they are 1 to {found}" if found else "none was found"
        raise InvalidParameterError(f"drop has number {missing[0]}, which is no vehicle of this image: {have}")
    numbers = np.arange(1, found + 1)
    added, pointed_log_sds = _added_boxes(by_hand, frame, size_px)
    overlaps = oriented_iou(detections.boxes, added).max(axis=1, initial=0.0) > nms_iou
    kept = ~np.isin(numbers, by_hand.drop) & ~overlaps
    n_added = len(added)

    looks, classes = detections.looks, detections.classes
    if classes is not None:
        commonest = int(np.bincount(classes).argmax()) if len(classes) else 0
        classes = np.concatenate([classes[kept], np.full(n_added, commonest, np.intp)])
    return replace(
        detections,
        boxes=np.concatenate([detections.boxes[kept], added]),
        scores=np.concatenate([detections.scores[kept], np.full(n_added, _STATED_SCORE)]),
        scales=None if detections.scales is None else np.concatenate([detections.scales[kept], np.ones(n_added)]),
        looks=None if looks is None else looks.take(kept[: len(looks)]),
        classes=classes,
        corrections=Corrections(
            numbers=np.concatenate([numbers[kept], found + 1 + np.arange(n_added)]),
            pointed_log_sds=np.concatenate([np.zeros(int(kept.sum())), pointed_log_sds]),
            n_dropped=len(by_hand.drop),
            n_added=n_added,
        ),
    )


def _added_boxes(
    by_hand: ByHand, frame: Frame, size_px: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Convert axes to boxes ``[k, 5]`` in pixels of the image, and compute the errors of their log lengths ``[k]``.

    Raises:
        InvalidParameterError: two of them are one vehicle.
    """
    axes = np.array([astuple(each) for each in by_hand.add], dtype=np.float64).reshape(-1, 4)
    unit = np.array(size_px) / (frame.size or size_px)
    ends = axes.reshape(-1, 2, 2) * unit
    along = ends[:, 1] - ends[:, 0]
    lengths = np.hypot(along[:, 0], along[:, 1])
    boxes = np.column_stack(
        [ends.mean(axis=1), lengths, lengths / CAR_LENGTH_OVER_WIDTH, np.arctan2(along[:, 1], along[:, 0]) % np.pi]
    )
    twice = np.argwhere(np.triu(oriented_iou(boxes, boxes) > 0.5, 1))
    if len(twice):
        one, other = twice[0] + 1
        raise InvalidParameterError(f"add {one} and add {other} are one vehicle: give each vehicle once")
    return boxes, np.sqrt(2) * _POINTED_SD_PX * unit.mean() / lengths
