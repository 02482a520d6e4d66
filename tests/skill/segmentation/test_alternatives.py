from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tests.models import blank_image
from tests.sam_models import write_sam
from tests.skill.segmentation.objects import OBJECT_RGB, full_mask, is_rectangle, picture, segmented
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.segmentation.alternatives import distinct
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmentation, Segmenter

if TYPE_CHECKING:
    from pathlib import Path


def found(box: tuple[int, int, int, int], score: float, window: Window) -> Segmentation:
    mask = np.zeros((window.height_px, window.width_px), bool)
    x1, y1, x2, y2 = box
    mask[y1 - window.y_px : y2 - window.y_px, x1 - window.x_px : x2 - window.x_px] = True
    return Segmentation(mask, window, score)


def test_masks_of_one_object_count_once_wherever_their_windows_lie() -> None:
    small, large, apart = Window(50, 60, 100, 100), Window(0, 0, 300, 200), Window(200, 0, 100, 60)
    pool = found((60, 70, 100, 110), 0.8, small)
    again = found((60, 70, 100, 108), 0.7, large)  # 95 % of it
    garden = found((60, 70, 130, 150), 0.9, large)
    roof = found((210, 10, 280, 50), 0.6, apart)
    empty = found((0, 0, 0, 0), 1.0, large)
    assert distinct([pool, again, garden, roof, empty]) == [garden, pool, roof]
    assert distinct([again, pool]) == [pool]
    assert distinct([empty, pool]) == [pool]
    assert distinct([empty]) == [empty]
    shed = found((5, 5, 20, 20), 0.5, large)
    assert distinct([shed, pool, garden, roof]) == [garden, pool, roof], "three at most"


def test_a_point_gives_the_object_and_what_else_it_may_mean(tmp_path: Path) -> None:
    sam = Segmenter(*write_sam(tmp_path))  # it takes all that looks alike: in a large crop both objects
    image = blank_image(800, 800)
    image[376:424, 376:424] = image[376:424, 504:552] = OBJECT_RGB
    seen = segmented(sam, image, Prompt(points=((392.0, 392.0, True),)))
    assert is_rectangle(full_mask(seen, image), (376, 376, 424, 424))
    assert seen.bounding_box == (376, 376, 424, 424)
    assert seen.alternatives[0].bounding_box == (376, 376, 552, 424)
    assert segmented(sam, image, Prompt(box=(370.0, 370.0, 430.0, 430.0))).alternatives == ()


def test_points_in_a_call_with_a_box_have_crops_of_their_own(tmp_path: Path) -> None:
    sam = Segmenter(*write_sam(tmp_path))
    image = picture(900, 700, (102, 102, 138, 138))
    prompts = [Prompt(box=(100.0, 100.0, 140.0, 140.0)), Prompt(points=((120.0, 120.0, True),))]
    with open_raster(image) as raster:
        boxed, pointed = sam.segment_all(raster, prompts)
    alone = segmented(sam, image, prompts[1])
    assert pointed.window == alone.window
    assert (pointed.mask == alone.mask).all()
    assert boxed.window == segmented(sam, image, prompts[0]).window
