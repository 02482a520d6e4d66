"""Lettering over a photograph is painted over before the scene-scale prior sees it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from research.scenes.captions import CAPTIONS
from research.scenes.lettering import own_fonts
from vehanchor.imagery.overlaid_lettering import paint_over_lettering, without_lettering
from vehanchor.imagery.sources.opening import open_raster

Picture = NDArray[np.uint8]


@pytest.fixture(scope="module")
def scene() -> Picture:
    rendered = render_scene(0.1, width_px=400, height_px=300, seed=3, layout="parking").image
    # Photographs have noise, and no two neighbours in a row are equal for long.
    noise = np.random.default_rng(0).normal(0, 3, rendered.shape)
    return np.clip(rendered + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", ["labels", "markers", "boxes"])
def test_lettering_is_painted_over(scene: Picture, kind: str) -> None:
    lettered = CAPTIONS[kind](scene, np.random.default_rng(5), own_fonts())
    painted = without_lettering(lettered)
    before = np.abs(lettered.astype(int) - scene).mean()
    assert np.abs(painted.astype(int) - scene).mean() < 0.5 * before


def test_a_photograph_stays_as_it_is(scene: Picture) -> None:
    assert without_lettering(scene) is scene


def test_a_compressed_photograph_stays_as_it_is(scene: Picture) -> None:
    _, file = cv2.imencode(".jpg", scene, [cv2.IMWRITE_JPEG_QUALITY, 75])
    compressed = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)
    assert without_lettering(compressed) is compressed


def test_a_page_is_not_painted_over() -> None:
    page = np.full((200, 300, 3), 255, np.uint8)
    page[40:60, 30:200] = 0
    assert without_lettering(page) is page


@pytest.mark.parametrize("darker", [1, 24])
def test_a_painted_image_has_the_brightness_of_the_image(scene: Picture, darker: int) -> None:
    lettered = CAPTIONS["labels"](scene // darker, np.random.default_rng(5), own_fonts())
    with open_raster(lettered) as raster:
        painted = paint_over_lettering(raster)
        assert painted is not raster
        assert (painted.read() == without_lettering(raster.read())).all()
