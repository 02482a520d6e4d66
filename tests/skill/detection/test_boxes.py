"""Oriented boxes: corners, IoU and NMS, against an oracle on polygons."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vehanchor.detection.boxes import (
    box_corners,
    boxes_from_corners,
    canonical_boxes,
    oriented_iou,
    oriented_nms,
)

# Boxes near one another, so that many overlap.
NEARBY_BOX = st.tuples(
    st.floats(-60, 60), st.floats(-60, 60), st.floats(4, 60), st.floats(2, 40), st.floats(-7, 7)
)


def _clip(subject: NDArray[np.float64], clip: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersect two convex polygons (Sutherland and Hodgman)."""
    output = list(subject)
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        points = output
        output = []
        for p, q in zip(points, points[1:] + points[:1], strict=True):
            # Positive on the inner side of the edge from a to b.
            side_p = _cross(b - a, p - a)
            side_q = _cross(b - a, q - a)
            p_is_inside = side_p >= 0
            q_is_inside = side_q >= 0
            if p_is_inside:
                output.append(p)
            if p_is_inside != q_is_inside:
                output.append(p + (q - p) * side_p / (side_p - side_q))
        if not output:
            break
    return np.array(output).reshape(-1, 2)


def _cross(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return float(first[0] * second[1] - first[1] * second[0])


def _area(polygon: NDArray[np.float64]) -> float:
    x = polygon[:, 0]
    y = polygon[:, 1]
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def polygon_iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """IoU of two canonical boxes, from their corners."""
    corners = box_corners(np.stack([a, b]))
    shared = _area(_clip(corners[0], corners[1]))
    return float(shared / (a[2] * a[3] + b[2] * b[3] - shared))


@given(st.lists(NEARBY_BOX, min_size=1, max_size=4))
def test_canonical_boxes_are_the_same_rectangles_with_the_long_side_first(
    rows: list[tuple[float, ...]],
) -> None:
    boxes = canonical_boxes(rows)
    assert (boxes[:, 2] >= boxes[:, 3]).all()
    assert ((boxes[:, 4] >= 0) & (boxes[:, 4] < np.pi)).all()
    for before, after in zip(box_corners(rows), box_corners(boxes), strict=True):
        distance = np.linalg.norm(before[:, None] - after[None], axis=2)
        assert distance.min(axis=1).max() < 1e-6


@given(st.lists(NEARBY_BOX, min_size=1, max_size=4))
def test_corners_and_boxes_are_inverse(rows: list[tuple[float, ...]]) -> None:
    boxes = canonical_boxes(rows)
    again = boxes_from_corners(box_corners(boxes))
    np.testing.assert_allclose(again[:, :4], boxes[:, :4], atol=1e-9)
    turned = np.abs(np.sin(again[:, 4] - boxes[:, 4]))
    square = boxes[:, 2] - boxes[:, 3] < 1e-6
    assert (turned[~square] < 1e-6).all()


@given(NEARBY_BOX, NEARBY_BOX)
def test_iou_equals_the_polygon_oracle(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    first = canonical_boxes([a])[0]
    second = canonical_boxes([b])[0]
    assert oriented_iou([a], [b])[0, 0] == pytest.approx(polygon_iou(first, second), abs=2e-3)


def test_iou_keeps_its_precision_far_from_the_origin() -> None:
    near = oriented_iou([[0, 0, 12, 5, 0.3]], [[2, 1, 12, 5, 0.4]])[0, 0]
    far = oriented_iou([[1e5, 2e5, 12, 5, 0.3]], [[1e5 + 2, 2e5 + 1, 12, 5, 0.4]])[0, 0]
    assert far == pytest.approx(near, abs=1e-5)


def _oracle_nms(
    boxes: NDArray[np.float64], scores: NDArray[np.float64], threshold: float
) -> list[int]:
    kept: list[int] = []
    for i in np.argsort(-scores, kind="stable"):
        if all(polygon_iou(boxes[i], boxes[k]) <= threshold for k in kept):
            kept.append(int(i))
    return kept


@given(st.lists(NEARBY_BOX, max_size=14), st.sampled_from([0.2, 0.45, 0.7]))
@settings(max_examples=40)
def test_nms_equals_the_oracle(rows: list[tuple[float, ...]], threshold: float) -> None:
    boxes = canonical_boxes(np.array(rows).reshape(-1, 5))
    scores = np.linspace(0.9, 0.1, len(boxes))
    ious = [polygon_iou(boxes[i], boxes[j]) for i in range(len(boxes)) for j in range(i)]
    # At a tie within float32, either answer is right.
    assume(all(abs(iou - threshold) >= 5e-3 for iou in ious))
    kept = oriented_nms(boxes, scores, iou_threshold=threshold)
    assert kept.tolist() == _oracle_nms(boxes, scores, threshold)


def _crowd(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """80 boxes, two of each vehicle, and their scores."""
    centres = rng.uniform(0, 200, (40, 2))
    lengths = rng.uniform(15, 25, 40)
    widths = rng.uniform(7, 10, 40)
    angles = rng.uniform(0, np.pi, 40)
    boxes = np.column_stack([centres, lengths, widths, angles])
    shifts = rng.normal(0, 0.3, boxes.shape) * (1, 1, 1, 1, 0.02)
    boxes = np.concatenate([boxes, boxes + shifts])
    return boxes, rng.uniform(0.1, 1, len(boxes))


@given(st.integers(0, 1000))
@settings(max_examples=25)
def test_nms_does_not_depend_on_the_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes, scores = _crowd(rng)
    shuffle = rng.permutation(len(boxes))
    of_shuffled = oriented_nms(boxes[shuffle], scores[shuffle])
    assert set(shuffle[of_shuffled].tolist()) == set(oriented_nms(boxes, scores).tolist())


@given(st.integers(0, 1000), st.floats(0, np.pi))
@settings(max_examples=25)
def test_nms_does_not_depend_on_rotation(seed: int, turn: float) -> None:
    boxes, scores = _crowd(np.random.default_rng(seed))
    # A tie may fall either way.
    assume((np.abs(oriented_iou(boxes, boxes) - 0.45) > 1e-3).all())
    cos = np.cos(turn)
    sin = np.sin(turn)
    turned = boxes.copy()
    turned[:, :2] = boxes[:, :2] @ np.array([[cos, sin], [-sin, cos]])
    turned[:, 4] += turn
    kept = oriented_nms(boxes, scores)
    assert set(oriented_nms(turned, scores).tolist()) == set(kept.tolist())


def test_boxes_that_overlap_exactly_by_the_limit_are_kept() -> None:
    boxes = np.array([[0, 0, 10, 4, 0], [5, 0, 10, 4, 0]], dtype=float)
    scores = [0.9, 0.5]
    limit = oriented_iou(boxes, boxes)[0, 1]
    assert limit == pytest.approx(1 / 3, rel=1e-6)
    assert oriented_nms(boxes, scores, iou_threshold=limit).tolist() == [0, 1]
    below = np.nextafter(limit, 0)
    assert oriented_nms(boxes, scores, iou_threshold=below).tolist() == [0]


def test_equal_scores_are_ordered_by_position_not_by_input_order() -> None:
    boxes = np.array([[0, 0, 10, 4, 0], [1, 0, 10, 4, 0]], dtype=float)
    assert oriented_nms(boxes, [0.5, 0.5]).tolist() == [0]
    assert oriented_nms(boxes[::-1], [0.5, 0.5]).tolist() == [1]


@pytest.mark.slow
def test_one_huge_box_does_not_slow_the_others() -> None:
    rng = np.random.default_rng(1)
    n = 10_000
    centres = rng.uniform(0, 6000, (n, 2))
    angles = rng.uniform(0, np.pi, n)
    boxes = np.column_stack([centres, np.full(n, 20.0), np.full(n, 8.0), angles])
    boxes[0] = (3000, 3000, 9000, 9000, 0.3)
    scores = rng.uniform(0.1, 1, len(boxes))
    oriented_nms(boxes[:10], scores[:10])
    started = time.perf_counter()
    kept = oriented_nms(boxes, scores)
    assert time.perf_counter() - started < 2.0
    assert 0 in kept
