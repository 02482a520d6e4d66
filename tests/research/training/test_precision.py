from __future__ import annotations

import math

import numpy as np
import pytest

from research.training.detector.precision import average_precision, match_detections

_LABELS = np.array([[50.0, 50, 30, 12, 0.3], [150, 50, 30, 12, 1.2], [250, 50, 40, 16, 0]])
_NONE = np.zeros((0, 5))


def test_perfect_detections_have_an_average_precision_of_1() -> None:
    matched = match_detections(_LABELS, np.array([0.9, 0.5, 0.7]), _LABELS, _NONE)
    assert average_precision([matched]) == pytest.approx(1.0)
    assert sorted(matched.label.tolist()) == [0, 1, 2]


def test_a_false_alarm_above_the_hits_lowers_precision_and_one_below_does_not() -> None:
    stray = np.array([[400.0, 300, 30, 12, 0]])
    boxes = np.concatenate([stray, _LABELS])
    above = match_detections(boxes, np.array([0.95, 0.9, 0.8, 0.7]), _LABELS, _NONE)
    below = match_detections(boxes, np.array([0.1, 0.9, 0.8, 0.7]), _LABELS, _NONE)
    assert average_precision([above]) == pytest.approx(3 / 4)  # the envelope is 3 of 4 at every recall
    assert average_precision([below]) == pytest.approx(1.0)


def test_a_missed_label_is_missing_recall() -> None:
    matched = match_detections(_LABELS[:2], np.array([0.9, 0.8]), _LABELS, _NONE)
    assert average_precision([matched]) == pytest.approx(2 / 3)


def test_a_second_box_on_the_same_label_is_a_false_alarm() -> None:
    twice = np.stack([_LABELS[0], _LABELS[0] + (1, 0, 0, 0, 0)])
    matched = match_detections(twice, np.array([0.8, 0.9]), _LABELS[:1], _NONE)
    assert matched.label.tolist() == [0, -1]
    assert matched.scores.tolist() == [0.9, 0.8]


def test_detections_on_ignored_boxes_neither_hit_nor_miss() -> None:
    inside = np.array([[50.0, 50, 20, 8, 0.3]])
    matched = match_detections(inside, np.array([0.9]), _NONE, _LABELS)
    assert len(matched.scores) == 0
    assert math.isnan(average_precision([matched]))
    beside = np.array([[80.0, 50, 30, 12, 0.3]])
    assert match_detections(beside, np.array([0.9]), _NONE, _LABELS).label.tolist() == [-1]


def test_images_are_ranked_together() -> None:
    right = match_detections(_LABELS[:1], np.array([0.6]), _LABELS[:1], _NONE)
    wrong = match_detections(_LABELS[1:2], np.array([0.9]), _LABELS[:1], _NONE)
    assert average_precision([right, wrong]) == pytest.approx(1 / 2 / 2)


def test_no_detections_and_no_labels_are_no_error() -> None:
    matched = match_detections(_NONE, np.zeros(0), _LABELS, _NONE)
    assert average_precision([matched]) == 0.0
