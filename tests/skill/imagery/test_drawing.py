"""Drawings are told from photographs by flat areas with sharp edges."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import Layout, render_scene
from research.scenes.lettering import own_fonts
from research.scenes.pages import PAGES
from vehanchor.imagery.drawing import drawing_chance_around, measure_drawing_chance
from vehanchor.imagery.sources.opening import open_raster


def _chance(picture: NDArray[np.uint8]) -> float:
    with open_raster(picture) as raster:
        return measure_drawing_chance(raster)


@pytest.mark.parametrize("kind", ["page", "chart", "map", "plan"])
def test_a_drawing_is_probably_no_photograph(kind: str) -> None:
    picture = PAGES[kind](np.random.default_rng(1), own_fonts())
    assert _chance(picture) > 0.5


@pytest.mark.parametrize("kind", ["page", "chart", "map"])
def test_a_compressed_drawing_is_probably_no_photograph(kind: str) -> None:
    picture = PAGES[kind](np.random.default_rng(1), own_fonts())
    _, file = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 50])
    compressed = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)
    assert _chance(compressed) > 0.5


@cache
def _scene(layout: Layout) -> NDArray[np.uint8]:
    return render_scene(0.1, width_px=400, height_px=400, seed=4, layout=layout).image


@pytest.mark.parametrize("blur_px", [0, 9])
@pytest.mark.parametrize("layout", ["parking", "countryside"])
def test_a_scene_is_no_drawing(layout: Layout, blur_px: int) -> None:
    picture = _scene(layout)
    if blur_px:
        picture = np.asarray(cv2.GaussianBlur(picture, (blur_px, blur_px), 0), np.uint8)
    assert _chance(picture) < 0.05


def test_a_border_without_data_does_not_make_a_drawing() -> None:
    picture = render_scene(0.1, width_px=400, height_px=400, seed=4).image.copy()
    picture[:, 150:] = 0
    assert _chance(picture) < 0.01


def test_an_image_that_is_smaller_than_a_patch_is_no_drawing() -> None:
    assert _chance(np.full((40, 300, 3), 255, np.uint8)) == 0.0


def test_cars_of_a_photograph_on_a_page_are_photographed() -> None:
    page = PAGES["page"](np.random.default_rng(1), own_fonts()).copy()
    page[:256, :256] = render_scene(0.1, width_px=256, height_px=256, seed=3).image
    boxes = np.array([[x, 128.0, 45.0, 20.0, 0.0] for x in (90, 128, 166)])
    with open_raster(page) as raster:
        overall = measure_drawing_chance(raster)
        assert overall > 0.5
        assert drawing_chance_around(raster, boxes, overall) < 0.05
        # A single box may be an icon, and the image is drawn.
        assert drawing_chance_around(raster, boxes[:1], overall) == overall
