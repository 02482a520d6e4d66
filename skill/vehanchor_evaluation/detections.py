"""Detections against labelled boxes: average precision, and whether lengths come out right."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import oriented_iou

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

HIT_IOU = 0.5
IGNORED_SHARE = 0.5  # a detection with so much of its area on a box to ignore is neither hit nor false alarm


class MatchedDetections(NamedTuple):
    """The detections of one image that count, and what they are.

    Attributes:
        scores: ``[n]`` of the detections that count, best first.
        lengths_px: ``[n]`` their lengths.
        label: ``[n]`` index of the label that each hits, -1 for a false alarm.
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
    """Match detections to labels as VOC does: from the best score down, each label once.

    Args:
        boxes: ``[n, 5]`` detections ``(x, y, length, width, angle)``.
        scores: ``[n]`` their scores.
        labels: ``[m, 5]`` labelled vehicles.
        ignored: ``[k, 5]`` boxes (doubtful, difficult, cut off) on which a detection is neither hit nor false alarm.
        iou: least oriented IoU of a hit.

    Returns:
        The detections that count.
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
    """Area below the precision envelope over recall, all images together (VOC 2010 and later, COCO).

    Returns:
        0..1; NaN without a label.
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
    """How long the boxes of labels of some lengths are.

    Attributes:
        low_px: shortest label of the bin.
        high_px: longest.
        labels: number of labels.
        found: how many of them were hit.
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
    """Signed error of the detected length by labelled length.

    Args:
        images: matched detections.
        edges_px: of the bins, ascending.
        min_score: detections below it are left out.

    Returns:
        One row a bin; bias and spread are NaN for a bin without a hit.
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
