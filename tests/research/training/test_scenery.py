"""What is made of images that nobody labelled with oriented boxes, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.detector.data import CROP_PX, Crop, distracted
from research.training.detector.distractors import KINDS, draw_distractors
from research.training.detector.places import looked_at
from research.training.detector.relabel import Consensus
from research.training.detector.scenery import Policy, judged, turned
from vehanchor.detection.boxes import box_corners

pytestmark = pytest.mark.slow

_GSD = 0.2
_CAR = np.array([100.0, 80.0, 23.0, 9.0, 0.6])  # 4.6 x 1.8 m


def _found(*boxes: np.ndarray, scores: list[float]) -> Consensus:
    return Consensus(np.array(boxes).reshape(-1, 5), np.array(scores))


def _upright(box: np.ndarray) -> np.ndarray:
    corners = box_corners(box[None])[0]
    (x0, y0), (x1, y1) = corners.min(axis=0), corners.max(axis=0)
    return np.array([[[x0, y0], [x1, y0], [x1, y1], [x0, y1]]])


def test_people_say_what_is_a_car_and_the_detector_how_it_stands() -> None:
    elsewhere = _CAR + np.array([60.0, 0, 0, 0, 0])
    rows = turned(_found(_CAR, elsewhere, scores=[0.3, 0.9]), _upright(_CAR), _GSD)
    assert [(kind, box.tolist()) for kind, box, _ in rows] == [("car", _CAR.tolist()), ("clutter", elsewhere.tolist())]


def test_a_car_that_the_detector_does_not_see_is_turned_only_where_its_box_tells() -> None:
    nothing = _found(scores=[])
    (straight,) = turned(nothing, _upright(_CAR * (1, 1, 1, 1, 0)), _GSD)
    assert straight[0] == "car"
    assert straight[1].tolist() == pytest.approx([100, 80, 23, 9, 0])
    (slanted,) = turned(nothing, _upright(_CAR), _GSD)
    assert slanted[0] == "ignore"


def test_size_overrules_score_and_a_look_overrules_both() -> None:
    policy = Policy(car=0.6, ignore=0.3)
    small = _CAR * (1, 1, 0.4, 0.4, 1)
    kinds = [
        judged(_found(box, scores=[score]), policy, _GSD, [])[0][0]
        for box, score in ((_CAR, 0.7), (_CAR, 0.4), (small, 0.9))
    ]
    assert kinds == ["car", "ignore", "clutter"]
    assert judged(_found(_CAR, scores=[0.9]), policy, _GSD, [(101.0, 80.0, "clutter")])[0][0] == "clutter"
    assert judged(_found(_CAR, scores=[0.05]), policy, _GSD, []) == []


def test_what_was_looked_at_is_of_known_kinds() -> None:
    kinds = {kind for rows in looked_at().values() for _, _, kind in rows}
    assert kinds == {"car", "ignore", "clutter"}


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_distractors_are_seeded_and_hide_what_they_cover(kind: str) -> None:
    grey = np.full((CROP_PX, CROP_PX, 3), 120, np.uint8)
    first, hides = draw_distractors(np.random.default_rng(3), grey, kind)
    second, _ = draw_distractors(np.random.default_rng(3), grey, kind)
    assert np.array_equal(first, second)
    assert 0 < hides.mean() < 0.95
    assert (first[~hides].astype(int) - 120).max(initial=0) < 60


def test_cars_below_distractors_are_no_cars_any_more() -> None:
    boxes = np.array([[x, y, 24.0, 10.0, 0.0] for x in range(20, 310, 30) for y in range(20, 310, 20)])
    crop = Crop(
        np.full((CROP_PX, CROP_PX, 3), 90, np.uint8), boxes, np.zeros((0, 4, 2)), np.ones((CROP_PX, CROP_PX), bool)
    )
    left = distracted(np.random.default_rng(1), crop)
    assert len(left.boxes) + len(left.ignore) <= len(boxes)
    assert 0 < len(left.boxes) < len(boxes)
