from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.skill.detection.polygons import NEARBY_BOX, polygon_iou
from vehanchor.detection.boxes import box_corners, boxes_from_corners, canonical_boxes, oriented_iou


@given(st.lists(NEARBY_BOX, min_size=1, max_size=4))
def test_canonical_boxes_are_the_same_rectangles_with_the_long_side_first(rows: list[tuple[float, ...]]) -> None:
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
    first, second = canonical_boxes([a])[0], canonical_boxes([b])[0]
    assert oriented_iou([a], [b])[0, 0] == pytest.approx(polygon_iou(first, second), abs=2e-3)


def test_iou_of_crossed_rectangles_is_known_exactly() -> None:
    cross = [[0, 0, 10, 2, 0.0], [0, 0, 10, 2, np.pi / 2]]
    assert oriented_iou(cross[:1], cross[1:])[0, 0] == pytest.approx(4 / 36, abs=1e-6)
    assert oriented_iou(cross[:1], cross[:1])[0, 0] == pytest.approx(1.0)
    assert oriented_iou(cross[:1], [[50, 0, 10, 2, 0]])[0, 0] == 0.0


def test_iou_keeps_its_precision_far_from_the_origin() -> None:
    near = oriented_iou([[0, 0, 12, 5, 0.3]], [[2, 1, 12, 5, 0.4]])[0, 0]
    far = oriented_iou([[1e5, 2e5, 12, 5, 0.3]], [[1e5 + 2, 2e5 + 1, 12, 5, 0.4]])[0, 0]
    assert far == pytest.approx(near, abs=1e-5)


def test_iou_with_no_boxes_is_an_empty_table() -> None:
    assert oriented_iou(np.zeros((0, 5)), [[0, 0, 2, 1, 0]]).shape == (0, 1)
