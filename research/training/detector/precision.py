"""Detections compared with labelled boxes: average precision."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import oriented_iou

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

HIT_IOU = 0.5
IGNORED_SHARE = 0.5  # a detection with this share of its area on an ignored box is neither hit nor false alarm


class MatchedDetections(NamedTuple):
    """Detections of one image without ignored ones, matched with labels.

    Attributes:
        scores: ``[n]`` scores, best first.
        lengths_px: ``[n]`` lengths.
        label: ``[n]`` index of the matched label; -1 for a false alarm.
        label_lengths_px: ``[m]`` lengths of all labels.
    """

    scores: NDArray[np.float64]
    lengths_px: NDArray[np.float64]
    label: NDArray[np.intp]
    label_lengths_px: NDArray[np.float64]


def match_detections(
    boxes: NDArray[np.float64],
    scores: NDArray[np.float64],
    labels: NDArray[np.float64],
    ignored: NDArray[np.float64],
    *,
    iou: float = HIT_IOU,
) -> MatchedDetections:
    """Match detections with labels as in VOC: by falling score, each label once.

    Args:
        boxes: ``[n, 5]`` detections ``(x, y, length, width, angle)``.
        scores: ``[n]`` their scores.
        labels: ``[m, 5]`` labelled vehicles.
        ignored: ``[k, 5]`` boxes (doubtful, difficult, cut off) where a detection is neither hit nor false alarm.
        iou: least oriented IoU of a hit.
    """
    order = np.argsort(-scores, kind="stable")
    boxes, scores = boxes[order], scores[order]
    overlap = oriented_iou(boxes, labels)
    label = np.full(len(boxes), -1, dtype=np.intp)
    free = np.ones(len(labels), dtype=bool)
    for i, row in enumerate(overlap):
        candidates = np.where(free, row, -1.0)
        if len(candidates) and candidates.max() >= iou:
            label[i] = int(candidates.argmax())
            free[label[i]] = False
    # intersection = IoU / (1 + IoU) * (a + b), as a share of the detection
    shared = oriented_iou(boxes, ignored)
    area, ignored_area = (rows[:, 2] * rows[:, 3] for rows in (boxes, ignored))
    covered = shared / (1 + shared) * (area[:, None] + ignored_area[None, :]) / np.maximum(area[:, None], 1e-9)
    counts = (label >= 0) | ~(covered >= IGNORED_SHARE).any(axis=1)
    return MatchedDetections(scores[counts], boxes[counts, 2], label[counts], labels[:, 2].copy())


def average_precision(images: Iterable[MatchedDetections]) -> float:
    """Compute the area under the precision envelope over recall for all images (VOC 2010 and later, COCO).

    Returns:
        0..1; NaN without labels.
    """
    chosen = list(images)
    n_labels = sum(len(image.label_lengths_px) for image in chosen)
    if n_labels == 0:
        return float("nan")
    scores = np.concatenate([image.scores for image in chosen])
    hit = np.concatenate([image.label >= 0 for image in chosen])[np.argsort(-scores, kind="stable")]
    hits = np.cumsum(hit)
    precision = hits / np.arange(1, len(hit) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[hit].sum() / n_labels)
