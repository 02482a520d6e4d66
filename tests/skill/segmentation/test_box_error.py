"""Masks of small objects, drawn with the box as it is, tighter and wider."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.sam_models import write_sam
from tests.skill.segmentation.objects import picture, segment
from vehanchor.imagery.raster import Window
from vehanchor.segmentation.box_error import box_log_sd, resized_boxes
from vehanchor.segmentation.contracts import SamContract
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmentation, Segmenter

_FIELD = (50, 50, 350, 350)
_IMAGE = Window(0, 0, width_px=400, height_px=400)


def _square(side_px: float) -> Prompt:
    """A box in the middle of the field, whose mask ends at the box alone."""
    low = 200 - side_px / 2
    high = 200 + side_px / 2
    return Prompt(box=(low, low, high, high))


def _segmented(folder: Path, prompt: Prompt, copy_px: float = 1.0) -> Segmentation:
    segmenter = Segmenter(*write_sam(folder))
    return segment(segmenter, picture(400, 400, _FIELD), prompt, copy_px=copy_px)


def _sd_of_squares(*sides_px: float) -> float:
    return box_log_sd([round(side**2) for side in sides_px])


def test_the_spread_is_that_of_all_three_areas() -> None:
    assert box_log_sd([100, 200, 400]) == pytest.approx(math.log(2) * math.sqrt(2 / 3))


def test_an_area_that_no_box_changes_has_no_spread() -> None:
    assert box_log_sd([300, 300, 300]) == 0.0


def test_a_small_mask_that_follows_its_box_has_the_error_of_the_box(tmp_path: Path) -> None:
    found = _segmented(tmp_path, _square(40))
    assert found.box_log_sd == pytest.approx(_sd_of_squares(36, 40, 44), rel=0.1)


def test_a_large_mask_has_no_error_of_the_box(tmp_path: Path) -> None:
    assert _segmented(tmp_path, _square(46)).box_log_sd == 0.0


def test_the_error_of_a_box_counts_in_pixels_of_the_callers_copy(tmp_path: Path) -> None:
    found = _segmented(tmp_path, _square(80), copy_px=2.0)
    assert found.box_log_sd == pytest.approx(_sd_of_squares(72, 80, 88), rel=0.1)


def test_an_exact_box_has_no_error(tmp_path: Path) -> None:
    assert _segmented(tmp_path, _square(30), copy_px=0.0).box_log_sd == 0.0


def test_a_mask_is_useless_where_its_box_decides(tmp_path: Path) -> None:
    assert _segmented(tmp_path, _square(30)).depends_on_box
    assert not _segmented(tmp_path, _square(40)).depends_on_box


def test_the_encoder_runs_once_for_all_boxes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crops: list[Window] = []
    encode = SamContract.encode

    def counted(contract: SamContract, image: object, window: Window) -> object:
        crops.append(window)
        return encode(contract, image, window)  # type: ignore[arg-type]

    monkeypatch.setattr(SamContract, "encode", counted)
    _segmented(tmp_path, _square(30))
    assert len(crops) == 1


def test_a_tiny_box_shrinks_to_the_smallest_prompt() -> None:
    shrunk, _ = resized_boxes((100.0, 100.0, 104.0, 150.0), _IMAGE, 2.0)
    assert shrunk == (101.0, 101.0, 103.0, 149.0)


def test_a_box_at_the_border_grows_inside_the_image() -> None:
    _, grown = resized_boxes((0.0, 1.0, 30.0, 399.0), _IMAGE, 2.0)
    assert grown == (0, 0, 32.0, 400)
