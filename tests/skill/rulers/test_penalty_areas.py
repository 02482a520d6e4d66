from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from vehanchor.imagery.sources.opening import open_raster
from vehanchor.rulers.penalty_areas import PenaltyArea, find_penalty_areas
from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROUGHLY = 1.5  # factor by which the scale is unknown
FULL = (40.32, 16.5, 18.32, 5.5, 11.0, 9.15)  # penalty area, goal area, spot, radius, metres
NINE_A_SIDE = (32.0, 13.0, 14.6, 4.6, 8.2, 6.4)  # of children, by The FA: nearly the same ratios


def _found(image: NDArray[np.uint8], gsd: float) -> list[PenaltyArea]:
    with open_raster(image) as raster:
        return find_penalty_areas(raster, Interval(gsd / ROUGHLY, gsd * ROUGHLY))


def _drawn(
    gsd: float, sizes: tuple[float, ...], turn_deg: float = 20.0, *, goal: bool = True, arc: bool = True
) -> NDArray[np.uint8]:
    """Draw white lines 12 cm wide on grass, a penalty area of these sizes in the middle of 90 m."""
    width, depth, goal_width, goal_depth, spot, radius = sizes
    fine, metres = 0.04, 90.0
    side = round(metres / fine)
    image = np.full((side, side, 3), (70, 105, 60), np.uint8)
    cos, sin = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))

    def line(*points: tuple[float, float]) -> None:
        there = np.array(points) @ np.array([[cos, sin], [-sin, cos]]) / fine + side / 2
        cv2.polylines(image, [np.rint(there * 16).astype(np.int32)], False, (200, 205, 195), 3, cv2.LINE_AA, 4)

    line((-34, 0), (34, 0))
    for across, along in ((width, depth), (goal_width, goal_depth))[: 2 if goal else 1]:
        x, y = across / 2 - 0.06, along - 0.06
        line((-x, 0), (-x, y), (x, y), (x, 0))
    if arc:
        turn = np.arccos((depth - spot) / radius)
        angles = np.linspace(-turn, turn, 30)
        line(*np.stack([(radius - 0.06) * np.sin(angles), spot + (radius - 0.06) * np.cos(angles)], axis=1).tolist())
    noisy = image + np.random.default_rng(0).normal(0, 12, image.shape)
    size = round(metres / gsd)
    small = cv2.resize(np.clip(noisy, 0, 255).astype(np.uint8), (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


@pytest.mark.parametrize("gsd", [0.08, 0.15])
def test_penalty_areas_are_measured_to_half_a_percent(gsd: float) -> None:
    areas = _found(_drawn(gsd, FULL), gsd)
    assert areas
    for area in areas:
        assert area.gsd_m_per_px == pytest.approx(gsd, rel=0.005)
        assert area.log_sd < 0.003
        front, side = np.hypot(*(area.corners[1] - area.corners[0])), np.hypot(*(area.corners[2] - area.corners[1]))
        assert front * gsd == pytest.approx(40.32, rel=0.005)
        assert side * gsd == pytest.approx(16.5, rel=0.005)


@pytest.mark.parametrize("turn_deg", [0.0, 33.0, 90.0, 200.0])
def test_the_goal_may_lie_to_any_side(turn_deg: float) -> None:
    image = _drawn(0.15, FULL, turn_deg)
    (area,) = _found(image, 0.15)
    assert area.gsd_m_per_px == pytest.approx(0.15, rel=0.005)


@pytest.mark.parametrize("gsd", [0.08, 0.16])
def test_the_area_of_a_childrens_pitch_is_none(gsd: float) -> None:
    assert len(_found(_drawn(gsd, FULL), gsd)) == 1
    assert _found(_drawn(gsd, NINE_A_SIDE), gsd) == []


@pytest.mark.parametrize("missing", ["goal area", "arc", "nothing"])
def test_one_ratio_alone_is_not_enough(missing: str) -> None:
    sizes = (40.32, 18.0, 18.32, 6.0, 11.0, 9.15) if missing == "nothing" else FULL
    assert _found(_drawn(0.12, sizes, goal=missing != "goal area", arc=missing != "arc"), 0.12) == []


def test_a_rough_scale_is_enough_and_a_wrong_one_finds_nothing() -> None:
    image = _drawn(0.12, FULL)
    assert len(_found(image, 0.12 * 1.4)) == len(_found(image, 0.12 / 1.4)) == 1
    assert _found(image, 0.12 * 3) == _found(image, 0.12 / 3) == []


def test_areas_are_sought_only_where_the_search_went() -> None:
    image = _drawn(0.15, FULL)
    with open_raster(image) as raster:
        assert len(find_penalty_areas(raster, Interval(0.1, 0.225), lambda x, y: x > 0 and y > 0)) == 1
        assert find_penalty_areas(raster, Interval(0.1, 0.225), lambda x, y: x < 0 and y < 0) == []
