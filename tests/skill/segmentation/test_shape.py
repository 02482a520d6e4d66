from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt, label

from vehanchor.segmentation import shape
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
    """Select the pixels whose centres are in a rectangle about the middle of the array."""
    # Off the middle, so that no side runs through centres of pixels.
    y, x = np.mgrid[:side, :side] + 0.5 - side / 2 + [[[0.13]], [[0.29]]]
    angle = np.deg2rad(degrees)
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    in_length = np.abs(along) <= width / 2
    in_width = np.abs(across) <= height / 2
    return np.asarray(in_length & in_width)


def _disc(radius: float, x: float = 0.0, y: float = 0.0, side: int = 400) -> NDArray[np.bool_]:
    rows, columns = np.mgrid[:side, :side] + 0.5 - side / 2
    return np.asarray((columns - x) ** 2 + (rows - y) ** 2 <= radius**2)


def _upright(
    x1: int, y1: int, x2: int, y2: int, width: int = 80, height: int = 60
) -> NDArray[np.bool_]:
    mask = np.zeros((height, width), dtype=bool)
    mask[y1:y2, x1:x2] = True
    return mask


def _random_mask(seed: int) -> NDArray[np.bool_]:
    noise = np.random.default_rng(seed).normal(size=(24, 31))
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5) > 0.02)


_masks = st.integers(0, 10**6).map(_random_mask)


def test_the_bounds_are_the_sides_of_the_outer_pixels() -> None:
    assert mask_bounds(_upright(20, 10, x2=60, y2=30)) == (20, 10, 60, 30)
    assert mask_bounds(_upright(79, 59, x2=80, y2=60)) == (79, 59, 80, 60)


@pytest.mark.parametrize(
    ("corners", "touches"),
    [
        ((1, 1, 79, 59), False),
        ((0, 5, 9, 9), True),
        ((5, 0, 9, 9), True),
        ((70, 5, 80, 9), True),
        ((5, 50, 9, 60), True),
    ],
)
def test_a_mask_touches_the_edge_with_its_outer_row_or_column(
    corners: tuple[int, int, int, int], touches: bool
) -> None:
    assert touches_edge(_upright(*corners)) is touches


@given(_masks)
@settings(max_examples=30)
def test_pieces_are_connected_by_sides_or_corners(mask: NDArray[np.bool_]) -> None:
    labels, n = label(mask, structure=np.ones((3, 3)))
    expected = sorted(np.bincount(labels.ravel())[1:], reverse=True) if n else []
    assert piece_areas_px(mask).tolist() == expected


@pytest.mark.parametrize("corners", [(20, 10, 60, 30), (0, 0, 80, 60), (5, 5, 6, 6), (3, 4, 50, 5)])
def test_the_perimeter_of_an_upright_rectangle_is_exact(
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
def test_the_perimeter_of_a_disc_is_that_of_its_circle(radius: float, tolerance: float) -> None:
    circumference = 2 * np.pi * radius
    assert perimeter(_disc(radius, 0.3, 0.1)) == pytest.approx(circumference, rel=tolerance)


@pytest.mark.parametrize(
    "size", [(40, 20), (20, 40), (3, 3), (1, 1), (1, 7), (7, 1), (2, 2), (80, 60)]
)
def test_the_extents_of_an_upright_rectangle_are_exact(size: tuple[int, int]) -> None:
    assert rotated_extents(_upright(0, 0, *size)) == pytest.approx((max(size), min(size)))


@pytest.mark.parametrize("degrees", range(3, 180, 11))
def test_the_extents_of_a_slanted_rectangle_are_right_to_a_pixel(degrees: int) -> None:
    assert rotated_extents(_rectangle(180, 70, degrees)) == pytest.approx((180, 70), abs=1.0)


def _square_distance(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Compute the distance of each point of the half-pixel lattice to the background."""
    padded = np.pad(mask, 1)
    background = np.zeros((2 * padded.shape[0] + 1, 2 * padded.shape[1] + 1), dtype=bool)
    for row, column in np.argwhere(~padded):
        background[2 * row : 2 * row + 3, 2 * column : 2 * column + 3] = True
    return np.asarray(distance_transform_edt(~background))


@given(_masks)
@settings(max_examples=40)
def test_the_inscribed_circle_has_the_exact_distance(mask: NDArray[np.bool_]) -> None:
    assume(mask.any())
    circle = inscribed_circle(mask)
    assert circle is not None
    distance = _square_distance(mask)
    assert circle.diameter == pytest.approx(distance.max(), rel=1e-5)
    # The circle fits at its own centre; the lattice begins one padded pixel before the mask.
    row = round(2 * circle.y) + 2
    column = round(2 * circle.x) + 2
    assert distance[row, column] == pytest.approx(circle.diameter, rel=1e-5)


_MASKS = [_disc(150), _rectangle(300, 41, 17), _upright(3, 5, x2=43, y2=25)]


@pytest.mark.parametrize("mask", _MASKS)
def test_the_circle_of_a_huge_mask_is_right_to_a_pixel(
    mask: NDArray[np.bool_], monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = inscribed_circle(mask)
    monkeypatch.setattr(shape, "_MAX_LATTICE_PX", 2_000)
    coarse = inscribed_circle(mask)
    assert fine is not None
    assert coarse is not None
    assert fine.diameter - 1.01 <= coarse.diameter <= fine.diameter + 0.5


@pytest.mark.parametrize("mask", _MASKS)
def test_the_perimeter_of_a_huge_mask_is_right_to_a_twentieth(
    mask: NDArray[np.bool_], monkeypatch: pytest.MonkeyPatch
) -> None:
    exact = perimeter(mask)
    monkeypatch.setattr(shape, "_MAX_LATTICE_PX", 2_000)
    assert perimeter(mask) == pytest.approx(exact, rel=0.05)


def _filled(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Select the pixels whose centres are inside the outline."""
    canvas = np.zeros(mask.shape, np.uint8)
    for piece in trace_outline(mask):
        # OpenCV takes corners in 1/256 px.
        rings = [np.rint((ring - 0.5) * 256).astype(np.int32) for ring in piece]
        inside = np.zeros(mask.shape, np.uint8)
        cv2.fillPoly(inside, rings[:1], 1, shift=8)
        for hole in rings[1:]:
            cv2.fillPoly(inside, [hole], 0, shift=8)
        canvas |= inside
    return canvas.astype(bool)


def _count_points(mask: NDArray[np.bool_]) -> int:
    return sum(len(ring) for piece in trace_outline(mask) for ring in piece)


def test_the_outline_runs_along_the_sides_of_pixels() -> None:
    mask = _upright(20, 10, x2=60, y2=30)
    mask[15:20, 30:40] = False
    (piece,) = trace_outline(mask)
    exterior, hole = piece
    assert sorted(map(tuple, exterior)) == [(20, 10), (20, 30), (60, 10), (60, 30)]
    assert sorted(map(tuple, hole)) == [(30, 15), (30, 20), (40, 15), (40, 20)]


@pytest.mark.parametrize("mask", [_disc(150), _disc(100) & ~_disc(40), _rectangle(200, 60, 33)])
def test_the_outline_of_a_smooth_object_covers_it(mask: NDArray[np.bool_]) -> None:
    assert _count_points(mask) <= 200
    filled = _filled(mask)
    assert (filled & mask).sum() / (filled | mask).sum() > 0.97


@pytest.mark.parametrize("scale", [1, 5])
def test_a_ragged_mask_has_at_most_200_points(scale: int) -> None:
    noise = np.random.default_rng(1).random((120, 160)) < 0.5
    mask = np.kron(noise, np.ones((scale, scale))).astype(bool)
    outline = trace_outline(mask)
    assert outline
    assert all(len(ring) >= 3 for piece in outline for ring in piece)
    assert _count_points(mask) <= 200


def test_a_mask_of_many_pieces_has_at_most_200_points() -> None:
    mask = np.zeros((400, 400), dtype=bool)
    mask[::4, ::4] = True
    assert 0 < sum(len(piece[0]) for piece in trace_outline(mask)) <= 200


def test_an_empty_mask_has_no_shape() -> None:
    empty = np.zeros((7, 9), dtype=bool)
    assert mask_bounds(empty) is None
    assert perimeter(empty) == 0.0
    assert trace_outline(empty) == []
    assert inscribed_circle(empty) is None
    assert len(piece_areas_px(empty)) == 0


def test_the_first_of_equal_circles_is_taken_whatever_the_rounding(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mask = np.ones((9, 40), dtype=np.bool_)
    first = inscribed_circle(mask)
    original = cv2.distanceTransform

    def round_otherwise(*arguments: Any) -> Any:
        # The last bit depends on the mask's place in memory.
        distance = original(*arguments)
        distance[:, : distance.shape[1] // 2] *= np.float32(1 - 1e-7)
        return distance

    monkeypatch.setattr(cv2, "distanceTransform", round_otherwise)
    assert inscribed_circle(mask) == first
