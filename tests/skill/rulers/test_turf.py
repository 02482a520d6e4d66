from __future__ import annotations

import cv2
import numpy as np
import pytest

from vehanchor.rulers.turf import smooth_ground

GSD, SIDE_PX = 0.3, 300


def _ground(rgb: tuple[int, int, int], noise: float, size_m: tuple[float, float] = (60, 40)) -> np.ndarray:
    """A rectangle of one colour in the middle of coarse black and white squares."""
    rng = np.random.default_rng(0)
    squares = rng.integers(0, 2, (60, 60), np.uint8) * 200
    image = np.repeat(cv2.resize(squares, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST)[..., None], 3, axis=2)
    width, height = (round(size / GSD / 2) for size in size_m)
    inside = np.s_[SIDE_PX // 2 - height : SIDE_PX // 2 + height, SIDE_PX // 2 - width : SIDE_PX // 2 + width]
    image[inside] = np.clip(np.array(rgb) + rng.normal(0, noise, image[inside].shape), 0, 255).astype(np.uint8)
    return image


@pytest.mark.parametrize("rgb", [(70, 105, 60), (150, 90, 60), (122, 126, 88)])
def test_turf_and_clay_are_found(rgb: tuple[int, int, int]) -> None:
    mask = smooth_ground(_ground(rgb, 5), GSD)
    assert mask.shape == (SIDE_PX, SIDE_PX)
    assert mask[SIDE_PX // 2, SIDE_PX // 2] == 1
    assert mask[5, 5] == 0


def test_thin_white_lines_leave_the_turf_smooth() -> None:
    image = _ground((70, 105, 60), 5)
    image[:, 100:200:40] = 220
    assert smooth_ground(image, GSD)[SIDE_PX // 2, SIDE_PX // 2] == 1


@pytest.mark.parametrize(
    ("rgb", "noise", "size_m"),
    [
        ((110, 112, 110), 5, (60, 40)),  # asphalt
        ((60, 90, 110), 5, (60, 40)),  # water
        ((70, 105, 60), 60, (60, 40)),  # crowns of trees
        ((70, 105, 60), 5, (25, 25)),  # a garden
        ((20, 30, 15), 3, (60, 40)),  # shade
    ],
)
def test_other_ground_is_not_searched(rgb: tuple[int, int, int], noise: float, size_m: tuple[float, float]) -> None:
    assert not smooth_ground(_ground(rgb, noise, size_m), GSD).any()
