from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt, label

from vehanchor.segmentation import shape as area
from vehanchor.segmentation.shape import (
    inscribed_circle,
    mask_bounds,
    perimeter,
    piece_areas_px,
    rotated_extents,
    touches_edge,
    trace_outline,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


def _rectangle(
    width: float, height: float, degrees: float = 0.0, side: int = 400
) -> NDArray[np.bool_]:
    """The pixels whose centres are in a rectangle about the middle of the array."""
    y, x = np.mgrid[:side, :side] + 0.5 - side / 2 + [[[0.13]], [[0.29]]]
    along, across = np.deg2rad(degrees) + np.array([0, np.pi / 2])
    u = x * np.cos(along) + y * np.sin(along)
    v = x * np.cos(across) + y * np.sin(across)
    return np.asarray((np.abs(u) <= width / 2) & (np.abs(v) <= height / 2))


def _disc(radius: float, x: float = 0.0, y: float = 0.0, side: int = 400) -> NDArray[np.bool_]:
    rows, columns = np.mgrid[:side, :side] + 0.5 - side / 2
    return np.asarray((columns - x) ** 2 + (rows - y) ** 2 <= radius**2)


def _upright(
    x1: int, y1: int, x2: int, y2: int, width: int = 80, height: int = 60
) -> NDArray[np.bool_]:
    mask = np.zeros((height, width), dtype=bool)
    mask[y1:y2, x1:x2] = True
    return mask


_masks = st.integers(0, 10**6).map(
    lambda seed: (
        cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(24, 31)), (0, 0), 1.5) > 0.02
    )
)


def test_the_bounds_are_the_sides_of_the_outer_pixels() -> None:
    assert mask_bounds(_upright(20, 10, x2=60, y2=30)) == (20, 10, 60, 30)
    assert mask_bounds(_upright(79, 59, x2=80, y2=60)) == (79, 59, 80, 60)
    assert mask_bounds(np.zeros((5, 5), dtype=bool)) is None


@pytest.mark.parametrize(
    ("corners", "touches"),
    [((1, 1, 79, 59), False), ((0, 5, 9, 9), True), ((5, 0, 9, 9), True), ((70, 5, 80, 9), True),
     ((5, 50, 9, 60), True)],
)  # fmt: skip
def test_a_mask_touches_the_edge_with_its_outer_row_or_column(
    corners: tuple[int, int, int, int], touches: bool
) -> None:
    assert touches_edge(_upright(*corners)) is touches


@given(_masks)
@settings(max_examples=30)
def test_pieces_hang_together_by_corners_and_add_up(mask: NDArray[np.bool_]) -> None:
    labels, n = label(mask, structure=np.ones((3, 3)))
    expected = sorted(np.bincount(labels.ravel())[1:], reverse=True) if n else []
    assert piece_areas_px(mask).tolist() == expected


# --- perimeter


@pytest.mark.parametrize("corners", [(20, 10, 60, 30), (0, 0, 80, 60), (5, 5, 6, 6), (3, 4, 50, 5)])
def test_the_perimeter_of_an_upright_rectangle_is_exact_also_at_the_edge(
    corners: tuple[int, int, int, int],
) -> None:
    x1, y1, x2, y2 = corners
    assert perimeter(_upright(*corners)) == pytest.approx(2 * (x2 - x1 + y2 - y1))


def test_holes_count_towards_the_perimeter() -> None:
    mask = _upright(20, 10, x2=60, y2=30)
    mask[15:20, 30:40] = False
    assert perimeter(mask) == pytest.approx(120 + 30)


@pytest.mark.parametrize(
    ("radius", "tolerance"), [(8.0, 0.05), (15.0, 0.03), (50.0, 0.01), (150.0, 0.01)]
)
def test_the_perimeter_of_a_disc(radius: float, tolerance: float) -> None:
    assert perimeter(_disc(radius, 0.3, 0.1)) == pytest.approx(2 * np.pi * radius, rel=tolerance)


# --- rotated rectangle


@pytest.mark.parametrize(
    "size", [(40, 20), (20, 40), (3, 3), (1, 1), (1, 7), (7, 1), (2, 2), (80, 60)]
)
def test_the_extents_of_an_upright_rectangle_are_exact(size: tuple[int, int]) -> None:
    assert rotated_extents(_upright(0, 0, *size)) == pytest.approx((max(size), min(size)))


@pytest.mark.parametrize("degrees", range(3, 180, 11))
def test_the_extents_of_a_slanted_rectangle_are_right_to_a_pixel(degrees: int) -> None:
    assert rotated_extents(_rectangle(180, 70, degrees)) == pytest.approx((180, 70), abs=1.0)


# --- inscribed circle


def _square_distance(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """From each point of the half-pixel lattice to the nearest background square, by brute force with scipy."""
    padded = np.pad(mask, 1)
    background = np.zeros((2 * padded.shape[0] + 1, 2 * padded.shape[1] + 1), dtype=bool)
    for row, column in np.argwhere(~padded):
        background[2 * row : 2 * row + 3, 2 * column : 2 * column + 3] = True
    return np.asarray(distance_transform_edt(~background))


@given(_masks)
@settings(max_examples=40)
def test_the_inscribed_circle_is_that_of_the_exact_distance(mask: NDArray[np.bool_]) -> None:
    assume(mask.any())
    circle = inscribed_circle(mask)
    assert circle is not None
    distance = _square_distance(mask)
    assert circle.diameter == pytest.approx(distance.max(), rel=1e-5)
    # and it really fits there
    assert distance[round(2 * circle.y) + 2, round(2 * circle.x) + 2] == pytest.approx(
        circle.diameter, rel=1e-5
    )


def test_a_huge_mask_misses_a_pixel_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    masks = [_disc(150), _rectangle(300, 41, 17), _upright(3, 5, x2=43, y2=25)]
    exact = [(inscribed_circle(mask), perimeter(mask)) for mask in masks]
    monkeypatch.setattr(area, "_MAX_LATTICE_PX", 2_000)
    for mask, (fine, length) in zip(masks, exact, strict=True):
        coarse = inscribed_circle(mask)
        assert coarse is not None
        assert fine is not None
        assert fine.diameter - 1.01 <= coarse.diameter <= fine.diameter + 0.5  # of whole pixels
        assert perimeter(mask) == pytest.approx(length, rel=0.05)  # of a picture of 2,000 px


# --- outline


def _filled(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels whose centres are inside the outline."""
    canvas = np.zeros(mask.shape, np.uint8)
    for part in trace_outline(mask):
        rings = [np.rint((ring - 0.5) * 256).astype(np.int32) for ring in part]
        inside = np.zeros(mask.shape, np.uint8)
        cv2.fillPoly(inside, rings[:1], 1, shift=8)
        for hole in rings[1:]:
            cv2.fillPoly(inside, [hole], 0, shift=8)
        canvas |= inside
    return canvas.astype(bool)


def test_the_outline_of_a_rectangle_with_a_hole_runs_along_its_pixels_sides() -> None:
    mask = _upright(20, 10, x2=60, y2=30)
    mask[15:20, 30:40] = False
    (part,) = trace_outline(mask)
    exterior, hole = part
    assert sorted(map(tuple, exterior)) == [(20, 10), (20, 30), (60, 10), (60, 30)]
    assert sorted(map(tuple, hole)) == [(30, 15), (30, 20), (40, 15), (40, 20)]


@pytest.mark.parametrize("mask", [_disc(150), _disc(100) & ~_disc(40), _rectangle(200, 60, 33)])
def test_the_outline_of_a_smooth_object_is_true_with_200_points(mask: NDArray[np.bool_]) -> None:
    parts = trace_outline(mask)
    assert sum(len(ring) for part in parts for ring in part) <= 200
    filled = _filled(mask)
    assert (filled & mask).sum() / (filled | mask).sum() > 0.97


@pytest.mark.parametrize("scale", [1, 5])
def test_a_ragged_mask_still_has_at_most_200_points(scale: int) -> None:
    noise = np.random.default_rng(1).random((120, 160)) < 0.5
    mask = np.kron(noise, np.ones((scale, scale))).astype(bool)
    parts = trace_outline(mask)
    assert parts
    assert sum(len(ring) for part in parts for ring in part) <= 200
    assert all(len(ring) >= 3 for part in parts for ring in part)
    many = np.zeros((400, 400), dtype=bool)
    many[::4, ::4] = True
    assert 0 < sum(len(part[0]) for part in trace_outline(many)) <= 200


def test_an_empty_mask_has_no_shape() -> None:
    empty = np.zeros((7, 9), dtype=bool)
    assert (perimeter(empty), trace_outline(empty), inscribed_circle(empty)) == (0.0, [], None)
    assert len(piece_areas_px(empty)) == 0


def test_the_first_of_equal_circles_is_taken_wherever_the_mask_lies_in_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mask = np.ones((9, 40), dtype=np.bool_)
    first = inscribed_circle(mask)
    original = cv2.distanceTransform

    def rounded_otherwise(*arguments: Any) -> Any:
        distance = original(*arguments)
        distance[:, : distance.shape[1] // 2] *= np.float32(1 - 1e-7)
        return distance

    monkeypatch.setattr(cv2, "distanceTransform", rounded_otherwise)
    assert inscribed_circle(mask) == first
