"""Seams between pictures that were put together."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.flight.ground import ground
from vehanchor.imagery.seams import Seam, find_seam
from vehanchor.imagery.sources.arrays import ArrayRaster

LEFT = ground(400, seed=1)
RIGHT = ground(400, seed=2)


def _seam(image: NDArray[np.uint8]) -> Seam | None:
    return find_seam(ArrayRaster(np.ascontiguousarray(image), "array", None))


def _compressed(image: NDArray[np.uint8], quality: int) -> NDArray[np.uint8]:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def _near(seam: Seam | None, x_px: int | None, y_px: int | None) -> bool:
    if seam is None or (seam.x_px is None) != (x_px is None):
        return False
    return abs((seam.x_px or 0) - (x_px or 0)) <= 4 and abs((seam.y_px or 0) - (y_px or 0)) <= 4


def test_one_picture_has_no_seam() -> None:
    assert _seam(LEFT) is None


def test_a_picture_too_narrow_to_be_reduced_has_no_seam() -> None:
    assert _seam(np.zeros((16, 20_000, 3), np.uint8)) is None


def test_one_strongly_compressed_picture_has_no_seam() -> None:
    assert _seam(_compressed(LEFT, 15)) is None


def test_two_pictures_side_by_side_have_a_seam() -> None:
    assert _near(_seam(_compressed(np.hstack([LEFT, RIGHT]), 90)), 400, None)


def test_two_pictures_one_above_the_other_have_a_seam() -> None:
    assert _near(_seam(np.vstack([LEFT, RIGHT])), None, 400)


def test_a_white_strip_between_pictures_is_a_seam() -> None:
    strip = np.full((400, 12, 3), 255, np.uint8)
    assert _near(_seam(np.hstack([LEFT, strip, RIGHT])), 400, None)


def test_a_white_strip_of_three_pixels_between_pictures_is_a_seam() -> None:
    strip = np.full((400, 3, 3), 255, np.uint8)
    assert _near(_seam(np.hstack([LEFT, strip, RIGHT])), 400, None)


def test_a_caption_below_a_photograph_is_no_seam() -> None:
    caption = np.full((40, 400, 3), 255, np.uint8)
    # The letters begin two pixels below the photograph: a thin strip is between them.
    cv2.putText(caption, "HIT 12 LINE", (10, 29), cv2.FONT_HERSHEY_SIMPLEX, 1.3, (0, 0, 0), 2)
    assert _seam(np.vstack([LEFT, caption])) is None


def test_a_white_frame_is_no_seam() -> None:
    framed = cv2.copyMakeBorder(LEFT, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    assert _seam(np.asarray(framed, np.uint8)) is None


def test_an_inset_has_a_corner() -> None:
    image = LEFT.copy()
    image[250:, 230:] = RIGHT[250:, 230:]
    assert _near(_seam(image), 230, 250)


@pytest.mark.parametrize("width_px", [1, 3])
def test_the_frame_of_an_inset_has_a_corner(width_px: int) -> None:
    image = LEFT.copy()
    image[40:220, 60:260] = 255
    inside = (slice(40 + width_px, 220 - width_px), slice(60 + width_px, 260 - width_px))
    image[inside] = RIGHT[inside]
    seam = _seam(_compressed(image, 90))
    assert seam is not None
    assert seam.x_px is not None
    assert seam.y_px is not None
    assert min(abs(seam.x_px - 60), abs(seam.x_px - 260)) <= 6
    assert min(abs(seam.y_px - 40), abs(seam.y_px - 220)) <= 6


def test_a_resized_inset_has_a_corner() -> None:
    image = LEFT.copy()
    image[40:180, 60:240] = RIGHT[40:180, 60:240]
    resized = cv2.resize(image, None, fx=1.27, fy=1.27, interpolation=cv2.INTER_LINEAR)
    assert _near(_seam(np.asarray(resized, np.uint8)), 76, 51)


def test_long_seams_need_no_step_in_every_pixel() -> None:
    image = LEFT.copy()
    image[200:, 220:] = RIGHT[200:, 220:]
    assert _near(_seam(_compressed(image, 75)), 220, 200)


@pytest.mark.parametrize("dark", [0.3, 0.6])
def test_the_edge_of_a_shadow_is_no_seam(dark: float) -> None:
    image = LEFT.copy()
    image[:, 170:] = (image[:, 170:] * dark).astype(np.uint8)
    assert _seam(image) is None


def test_a_kerb_with_one_ground_on_both_sides_is_no_seam() -> None:
    sides = np.random.default_rng(3).choice((-1, 1), 400)
    image = LEFT.astype(np.int64) // 2 + 64
    image[:, 200:203] += np.multiply.outer(sides, (60, 40, 20))[:, :, None]
    assert _seam(np.clip(image, 0, 255).astype(np.uint8)) is None


def test_plain_ground_between_things_is_no_seam() -> None:
    image = np.full((300, 400, 3), 110, np.uint8)
    for left, top in ((20, 10), (20, 160), (200, 10), (330, 160)):
        image[top : top + 140, left : left + 50] = LEFT[top : top + 140, left : left + 50]
    assert _seam(image) is None


@pytest.mark.parametrize("quality", [None, 85])
def test_the_grid_of_a_map_is_no_seam(quality: int | None) -> None:
    image = LEFT.copy()
    image[60::90] = 255
    image[:, 70::90] = 255
    if quality is not None:
        image = _compressed(image, quality)
    assert _seam(image) is None


def test_an_image_enlarged_without_interpolation_has_no_seam() -> None:
    large = cv2.resize(LEFT[:80, :80], None, fx=7, fy=7, interpolation=cv2.INTER_NEAREST)
    assert _seam(np.asarray(large, np.uint8)) is None


def test_a_brighter_inset_beside_the_border_has_a_corner() -> None:
    image = (LEFT * 0.5).astype(np.uint8)
    image[:160, 260:] = RIGHT[:160, 260:] // 2 + 120
    assert _near(_seam(_compressed(image, 85)), 260, 160)


def test_a_brighter_roof_whose_edges_the_camera_blurred_is_no_inset() -> None:
    image = (LEFT * 0.5).astype(np.uint8)
    image[100:240, 130:300] = image[100:240, 130:300] + 100
    blurred = cv2.GaussianBlur(image, (0, 0), 2.5)
    assert _seam(np.asarray(blurred, np.uint8)) is None
