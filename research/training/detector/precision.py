"""Detections compared with labelled boxes: average precision and errors of length."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import oriented_iou

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

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


class LengthError(NamedTuple):
    """Errors of detected lengths for labels in a range of lengths.

    Attributes:
        low_px: shortest label of the bin.
        high_px: longest label of the bin.
        labels: number of labels.
        found: number of labels that were detected.
        bias: median of ``length / label - 1`` of those.
        spread: standard deviation of the same, from the quartiles.
    """

    low_px: float
    high_px: float
    labels: int
    found: int
    bias: float
    spread: float


def length_errors(
    images: Iterable[MatchedDetections], edges_px: Sequence[float], *, min_score: float = 0.0
) -> list[LengthError]:
    """Compute the signed error of detected lengths by labelled length.

    Args:
        images: matched detections.
        edges_px: edges of the bins, ascending.
        min_score: detections below this score are left out.

    Returns:
        One row per bin; bias and spread are NaN for a bin without detections.
    """
    truth, every, error = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for image in images:
        hit = (image.label >= 0) & (image.scores >= min_score)
        label = image.label_lengths_px[image.label[hit]]
        truth.append(label)
        error.append(image.lengths_px[hit] / label - 1)
        every.append(image.label_lengths_px)
    lengths, errors, labels = np.concatenate(truth), np.concatenate(error), np.concatenate(every)
    rows = []
    for low, high in pairwise(edges_px):
        inside = errors[(lengths >= low) & (lengths < high)]
        quartiles = np.percentile(inside, [25, 50, 75]) if len(inside) else np.full(3, np.nan)
        rows.append(
            LengthError(
                low,
                high,
                int(np.count_nonzero((labels >= low) & (labels < high))),
                len(inside),
                float(quartiles[1]),
                float((quartiles[2] - quartiles[0]) / 1.349),
            )
        )
    return rows
