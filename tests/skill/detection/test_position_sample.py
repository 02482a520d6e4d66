"""Candidates that the verifier scores in a crowded tile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from research.scenes import render_scene
from vehanchor.detection.detector import load_detector
from vehanchor.detection.position_sample import position_sample
from vehanchor.detection.search import search
from vehanchor.detection.verifier import Verifier
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Objects


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


def test_a_search_verifies_fewer_candidates_a_tile_once_it_has_found_many_vehicles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking").image
    counts: list[int] = []
    scored = Verifier.scored

    def counted(self: Verifier, pixels: NDArray[np.uint8], found: Objects, *, size_odds: Any = 0.0) -> Objects:
        counts.append(len(found))
        return scored(self, pixels, found, size_odds=size_odds)

    monkeypatch.setattr(Verifier, "scored", counted)
    monkeypatch.setattr("vehanchor.detection.search.ANYTIME_PIXELS", 1)
    for name, value in (("_MOST_VERIFIED", 60), ("_LEAST_VERIFIED", 10)):
        monkeypatch.setattr(f"vehanchor.detection.search.{name}", value)
    verified, found = {}, {}
    for many in (10**6, 30):
        monkeypatch.setattr("vehanchor.detection.search._MANY_VEHICLES", many)
        with open_raster(image) as raster:
            found[many] = search(raster, load_detector(resolve_model()), Search(tile_px=512, search_scales=False))
        verified[many], counts = counts, []
    first = verified[30].index(min(verified[30]))
    assert verified[30][0] == verified[10**6][0] >= 60
    assert max(verified[30][first:]) < 60 <= max(verified[10**6][first:])
    assert found[30].n_skipped > found[10**6].n_skipped > 0
    lengths = [np.median(each.boxes[:, 2]) for each in found.values()]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.05)
