"""Candidates that the verifier scores in a crowded tile."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.position_sample import position_sample

if TYPE_CHECKING:
    from numpy.typing import NDArray


def _car_park() -> NDArray[np.float64]:
    """Rows of 2,000 cars, each found twice, two pixels apart; the cars of the right half are longer."""
    grid = np.stack(np.meshgrid(np.arange(20.0, 1000, 24), np.arange(15.0, 1000, 20)), axis=-1).reshape(-1, 2)
    lengths = np.where(grid[:, 0] < 512, 20.0, 24.0)
    once = np.column_stack([grid, lengths, np.full(len(grid), 9.0), np.zeros(len(grid))])
    return np.concatenate([once, once + np.array([2, 0, 0, 0, 0])])


def test_a_sample_is_large_enough_and_favours_no_place_and_no_size() -> None:
    boxes = _car_park()
    chosen = position_sample(boxes, 128)
    assert 128 <= len(chosen) < 160
    assert 0.3 < np.mean(boxes[chosen, 2] > 22) < 0.7
    for axis in (0, 1):
        assert np.bincount((boxes[chosen, axis] // 256).astype(int), minlength=4).min() >= 10


def test_boxes_of_one_vehicle_stay_together_and_their_order_does_not_matter() -> None:
    boxes = _car_park()
    chosen, half = set(position_sample(boxes, 128).tolist()), len(boxes) // 2
    split = sum((k + half) not in chosen for k in chosen if k < half)
    assert split <= 0.1 * len(chosen)
    order = np.random.default_rng(0).permutation(len(boxes))
    assert set(order[position_sample(boxes[order], 128)].tolist()) == chosen


def test_few_candidates_are_all_taken() -> None:
    boxes = _car_park()[:128]
    assert position_sample(boxes, 128).tolist() == list(range(128))
    assert position_sample(np.zeros((0, 5)), 128).tolist() == []
