"""The photograph in a page, a slide or a program is found, and measured as if it were alone."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from research.scenes.captions import Captioned, caption, program
from research.scenes.lettering import own_fonts
from research.scenes.pages import PAGES
from vehanchor import estimate_gsd, measure_areas, measure_distance
from vehanchor.analysis.image_doubts import with_image_doubts
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.photograph import PartRaster, find_photographs
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options.pixel_grid import PixelGrid

Picture = NDArray[np.uint8]


@pytest.fixture(scope="module")
def scene() -> Picture:
    return render_scene(0.1, width_px=300, height_px=240, seed=3, layout="parking").image


def _place(picture: Picture) -> tuple[int, int, int, int]:
    """Find left, top, width and height of the photograph in a picture."""
    with open_raster(picture) as raster:
        part = find_photographs(raster)[0]
        return (*part.origin_px, part.width_px, part.height_px)


def _on_page(photograph: Picture, left: int, top: int) -> Picture:
    page = PAGES["page"](np.random.default_rng(1), own_fonts()).copy()
    height, width = photograph.shape[:2]
    page[top - 12 : top + height + 12, :] = page[0, 0]
    page[top : top + height, left : left + width] = photograph
    return page


def test_the_photograph_on_a_page_is_found_to_the_pixel(scene: Picture) -> None:
    assert _place(_on_page(scene, 40, 61)) == (40, 61, 300, 240)


@pytest.mark.parametrize("draw", [caption, program])
def test_a_photograph_with_a_caption_or_panels_is_found(scene: Picture, draw: Captioned) -> None:
    picture = draw(scene, np.random.default_rng(2), own_fonts())
    assert _place(picture) == (0, 0, 300, 240)


def test_a_photograph_on_a_compressed_page_is_found(scene: Picture) -> None:
    _, file = cv2.imencode(".jpg", _on_page(scene, 40, 61), [cv2.IMWRITE_JPEG_QUALITY, 80])
    place = _place(np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8))
    assert np.abs(np.subtract(place, (40, 61, 300, 240))).max() <= 8


def test_a_photograph_alone_is_searched_whole(scene: Picture) -> None:
    assert _place(scene) == (0, 0, 300, 240)


def test_two_photographs_on_a_page_have_no_common_scale(scene: Picture) -> None:
    page = np.full((620, 400, 3), 255, np.uint8)
    page[20:260, 50:350] = scene
    reduced = cv2.resize(scene, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA)
    page[300:492, 50:290] = reduced
    record = estimate_gsd(page)
    assert record.status != "ok"
    [several] = [notice for notice in record.warnings if notice.code == "several_pictures"]
    assert "(50, 20), (50, 300) px" in several.message


@pytest.mark.parametrize("kind", ["page", "chart", "map", "window"])
def test_a_drawing_has_no_photograph_in_it(kind: str) -> None:
    picture = PAGES[kind](np.random.default_rng(1), own_fonts())
    height, width = picture.shape[:2]
    assert _place(picture) == (0, 0, width, height)


def test_a_line_across_a_photograph_does_not_cut_it(scene: Picture) -> None:
    page = np.full((320, 400, 3), 255, np.uint8)
    page[40:280, 50:350] = scene
    page[150:152, 50:350] = 255
    assert _place(page) == (50, 40, 300, 240)


def test_a_part_reads_pixels_of_its_image(scene: Picture) -> None:
    with open_raster(scene) as raster:
        part = PartRaster(raster, Window(10, 20, width_px=100, height_px=50))
        corner = part.read(Window(5, 6, width_px=7, height_px=8))
    assert (corner == scene[26:34, 15:22]).all()


def test_a_page_has_the_scale_of_its_photograph(scene: Picture) -> None:
    bare = estimate_gsd(scene)
    page = estimate_gsd(_on_page(scene, 40, 61))
    assert page.gsd_m_per_px == bare.gsd_m_per_px
    assert page.confidence == bare.confidence
    assert "part_searched" in [warning.code for warning in page.warnings]


def test_a_given_focal_length_is_that_of_the_photograph_on_a_page(scene: Picture) -> None:
    height: dict[str, Any] = {"height_m": 80, "height_basis": "measured", "focal_35mm": 50}
    bare = estimate_gsd(scene, rulers=["height"], **height)
    page = estimate_gsd(_on_page(scene, 40, 61), rulers=["height"], **height)
    assert page.gsd_m_per_px == pytest.approx(bare.gsd_m_per_px, rel=0.01)
    # What looks like a margin may be plain ground.
    assert bare.status == "ok"
    assert page.status == "low_confidence"


def test_the_place_of_a_photograph_is_stated_in_pixels_of_the_file(scene: Picture) -> None:
    with open_raster(scene) as raster:
        facts = image_facts(raster)._replace(file_grid=PixelGrid(150, 240, aspect=0.5))
        part = PartRaster(raster, Window(20, 30, width_px=200, height_px=180))
        facts = with_image_doubts(facts, part, metadata=True, check_seams=False)
    assert "from (10, 30) to (110, 210) px" in facts.notices[0].message


def test_what_is_beside_the_photograph_is_not_measured_with_its_scale(scene: Picture) -> None:
    page = _on_page(scene, 40, 61)
    inside = [(60, 100), (120, 100), (120, 160), (60, 160)]
    beside = [(350, 100), (390, 100), (390, 140), (350, 140)]
    in_photograph, on_paper = measure_areas(page, [inside, beside], must_fit={"diameter_m": 1})
    line = measure_distance(page, beside[:2])
    assert in_photograph.status == "ok"
    for measured in (on_paper, line):
        assert measured.status == "low_confidence"
        assert measured.warnings[-1].code == "beside_photograph"
    assert on_paper.fit is not None
    assert on_paper.fit.fit_probability == 0.0
