"""What is made of images that nobody labelled with oriented boxes, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch")

from research.training.detector.data import CROP_PX, Crop, distracted
from research.training.detector.distractors import KINDS, draw_distractors

pytestmark = pytest.mark.slow


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
