"""Pairs of near points."""

from __future__ import annotations

import numpy as np
import pytest

from vehanchor.detection import near_pairs as module
from vehanchor.detection.near_pairs import near_pairs
from vehanchor.errors import ModelContractError


def _all_pairs(first: np.ndarray, second: np.ndarray, reach: float) -> set[tuple[int, int]]:
    distance = np.linalg.norm(first[:, None] - second[None], axis=2)
    return {(int(i), int(j)) for i, j in np.argwhere(distance <= reach)}


@pytest.mark.parametrize("reach", [0.5, 3.0, 17.0, 80.0, 500.0])
@pytest.mark.parametrize(("width", "height"), [(100, 100), (2000, 3), (3, 2000)])
def test_the_pairs_are_those_of_all_comparisons(width: float, height: float, reach: float) -> None:
    rng = np.random.default_rng(5)
    first, second = (rng.uniform((0, -40), (width, height), (n, 2)) for n in (150, 90))
    i, j = near_pairs(first, second, reach)
    assert len(i) == len(set(zip(i.tolist(), j.tolist(), strict=True)))
    assert set(zip(i.tolist(), j.tolist(), strict=True)) == _all_pairs(first, second, reach)


def test_points_on_a_grid_at_exactly_the_reach_are_near() -> None:
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2)
    assert set(zip(*(each.tolist() for each in near_pairs(grid, grid, 1.0)), strict=True)) == _all_pairs(grid, grid, 1)


def test_blocks_do_not_change_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(1).uniform(0, 60, (200, 2))
    whole = near_pairs(points, points, 7.0)
    monkeypatch.setattr(module, "_BLOCK_PAIRS", 37)
    assert all(np.array_equal(a, b) for a, b in zip(whole, near_pairs(points, points, 7.0), strict=True))


@pytest.mark.parametrize("apart", [0.0, 1e9])
def test_a_reach_of_zero_finds_equal_points_only(apart: float) -> None:
    points = np.array([(1.0, 2.0), (1.0, 2.0), (1.0 + apart, 3.0)])
    i, j = near_pairs(points, points, 0.0)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 2)]


def test_no_points_have_no_pairs() -> None:
    some, none = np.ones((3, 2)), np.zeros((0, 2))
    assert [len(each) for pairs in (near_pairs(some, none, 5.0), near_pairs(none, some, 5.0)) for each in pairs] == [
        0
    ] * 4


def test_too_many_near_points_are_refused_before_they_are_listed() -> None:
    with pytest.raises(ModelContractError, match="not a vehicle detector"):
        near_pairs(np.zeros((20_000, 2)), np.zeros((20_000, 2)), 1.0)
