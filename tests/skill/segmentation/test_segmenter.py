from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.models import blank_image, write_detector, write_other_model
from tests.sam_models import (
    write_sam,
    write_sam2,
)
from tests.skill.segmentation.objects import OBJECT_RGB, full_mask, is_rectangle, segmented
from vehanchor.errors import (
    ImageTooLargeError,
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
    PromptError,
)
from vehanchor.imagery.raster import Window
from vehanchor.options import Frame, ImageLimits
from vehanchor.options.reading import FrameSize
from vehanchor.segmentation.prompt import MIN_BOX_PX, Prompt, prompt_in_image, read_prompt
from vehanchor.segmentation.segmenter import Segmenter


def test_the_card_names_both_files(tmp_path: Path) -> None:
    segmenter = Segmenter(*write_sam(tmp_path))
    both = segmenter.encoder_path.read_bytes() + segmenter.decoder_path.read_bytes()
    card = segmenter.card
    assert card.sha256 == hashlib.sha256(both).hexdigest()
    assert card.name == segmenter.encoder_path.stem
    assert (card.min_score, card.mask_area_log_sd, card.licence) == (0.7, 0.1, None)


def test_what_is_no_segmenter_is_refused_with_what_was_found(tmp_path: Path) -> None:
    encoder, decoder = write_sam(tmp_path)
    (tmp_path / "two").mkdir()
    encoder2, decoder2 = write_sam2(tmp_path / "two")
    other = write_other_model(tmp_path / "classifier.onnx")
    detector = write_detector(tmp_path / "detector.onnx")
    for pair in (
        (encoder, decoder2),
        (encoder2, decoder),
        (other, decoder),
        (detector, detector),
        (encoder, encoder),
    ):
        with pytest.raises(ModelContractError, match="decoder in: ") as caught:
            Segmenter(*pair)
        assert caught.value.code == "model_contract"
    with pytest.raises(ModelContractError, match="swapped"):
        Segmenter(decoder, encoder)
    with pytest.raises(ModelContractError, match="logits"):
        Segmenter(encoder, other)
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ModelContractError, match=r"text\.onnx"):
        Segmenter(tmp_path / "text.onnx", decoder)
    with pytest.raises(ModelNotFoundError, match="missing"):
        Segmenter(encoder, tmp_path / "missing.onnx")


def test_the_files_say_how_much_to_trust_them(tmp_path: Path) -> None:
    metadata = {
        "vehanchor.name": "small", "license": "Apache-2.0", "vehanchor.min_score": "0.6",
        "vehanchor.mask_area_log_sd": "0.05",
    }  # fmt: skip
    card = Segmenter(*write_sam(tmp_path, metadata=metadata)).card
    assert (card.name, card.licence, card.min_score, card.mask_area_log_sd) == (
        "small",
        "Apache-2.0",
        0.6,
        0.05,
    )
    with pytest.raises(ModelContractError, match="mask_area_log_sd"):
        Segmenter(*write_sam(tmp_path, metadata={"vehanchor.mask_area_log_sd": "wide"}))


WHOLE = Frame()


def test_a_box_or_points_are_read_as_numbers() -> None:
    assert read_prompt((1, np.float32(2), "3", 4.5), None) == Prompt(box=(1.0, 2.0, 3.0, 4.5))  # type: ignore[arg-type]
    assert read_prompt(None, [(1, 2), (3, 4, False), (5, 6, True)]) == Prompt(
        points=((1.0, 2.0, True), (3.0, 4.0, False), (5.0, 6.0, True))
    )


@pytest.mark.parametrize(
    ("box", "points", "message"),
    [
        (None, None, "neither is given"),
        ((0, 0, 5, 5), [(1, 1)], "both are given"),
        (5, None, "box is 5: use x1, y1, x2, y2"),
        (None, 5, "points is 5: use one or more of x, y"),
        (None, [5], "a point is 5: use x, y"),
        ((0, 0, 5), None, "box is .*: use x1, y1, x2, y2, finite numbers"),
        ((5, 0, 5, 5), None, "reversed or empty"),
        ((0, 6, 5, 5), None, "reversed or empty"),
        ((0, 0, float("nan"), 5), None, "finite"),
        ((0, 0, "wide", 5), None, "wide.*: use x1, y1, x2, y2"),
        (None, [(1,)], "a point is .*: use x, y and whether"),
        (None, [(1, float("nan"))], "finite"),
        (None, [(1, 2, False)], "no point is on the object"),
    ],
)
def test_what_names_nothing_in_any_image_is_refused(box: Any, points: Any, message: str) -> None:
    with pytest.raises(PromptError, match=message) as caught:
        read_prompt(box, points)
    assert caught.value.code == "invalid_prompt"
    assert isinstance(caught.value, InvalidParameterError)


def test_a_box_that_rounding_took_over_the_edge_is_pulled_in() -> None:
    assert prompt_in_image(
        Prompt(box=(-0.9, -0.5, 60.9, 40.3)), WHOLE, width_px=60, height_px=40
    ) == Prompt(box=(0.0, 0.0, 60.0, 40.0))
    framed = prompt_in_image(
        Prompt(box=(-0.9, 0.0, 30.9, 20.0)), Frame(FrameSize(30, 20)), width_px=60, height_px=40
    )
    assert framed == Prompt(box=(0.0, 0.0, 60.0, 40.0))


@pytest.mark.parametrize(
    ("prompt", "frame", "message"),
    [
        (
            Prompt(box=(-1.0, 0.0, 30.0, 30.0)),
            WHOLE,
            "box -1, 0, 30, 30 is not inside the 60 x 40 px image",
        ),
        (Prompt(box=(0.0, 0.0, 61.0, 30.0)), WHOLE, "60 x 40 px image"),
        (Prompt(box=(0.0, 0.0, 32.0, 10.0)), Frame(FrameSize(30, 20)), "30 x 20 px frame"),
        (Prompt(box=(3.0, 3.0, 4.9, 30.0)), WHOLE, f"at least {MIN_BOX_PX:g} px a side"),
        (Prompt(box=(59.0, 3.0, 60.9, 30.0)), WHOLE, f"at least {MIN_BOX_PX:g} px a side"),
        (Prompt(points=((5.0, 5.0, True), (60.0, 5.0, True))), WHOLE, "point 60, 5 is not inside"),
        (Prompt(points=((-0.1, 5.0, True),)), WHOLE, "point -0.1, 5 is not inside"),
    ],
)
def test_what_names_nothing_in_this_image_is_refused(
    prompt: Prompt, frame: Frame, message: str
) -> None:
    with pytest.raises(PromptError, match=message):
        prompt_in_image(prompt, frame, width_px=60, height_px=40)


@pytest.mark.parametrize(
    ("prompt", "side"),
    [
        (Prompt(box=(1500.0, 1500.0, 1510.0, 1505.0)), 256),
        (Prompt(box=(1200.0, 1500.0, 1500.0, 1600.0)), 600),
    ],
)
def test_the_crop_of_a_box_has_twice_its_side_and_at_least_256_px(
    segmenter: Segmenter, prompt: Prompt, side: int
) -> None:
    window = segmented(segmenter, blank_image(3000, 3000), prompt).window
    assert (window.width_px, window.height_px) == (side, side)


def test_the_crop_of_a_point_grows_until_the_object_is_in_it(segmenter: Segmenter) -> None:
    image = blank_image(3000, 2600)
    image[1100:1612, 1000:2200] = OBJECT_RGB
    found = segmented(segmenter, image, Prompt(points=((1500.0, 1300.0, True),)))
    assert found.window.width_px == pytest.approx(2 * 1200, rel=0.05)
    assert found.alternatives == ()
    assert found.bounding_box == pytest.approx((1000, 1100, 2200, 1612), abs=40)
    everything = segmented(
        segmenter,
        np.full((1300, 1300, 3), OBJECT_RGB, np.uint8),
        Prompt(points=((450.0, 650.0, True),)),
    )
    assert everything.window == Window(0, 0, width_px=1300, height_px=1300)
    assert everything.mask.all()


def test_a_large_crop_is_read_in_strips_and_no_larger_than_the_limits(segmenter: Segmenter) -> None:
    image = np.full((2500, 3000, 3), OBJECT_RGB, np.uint8)
    box = (100.9, 60.1, 2850.1, 2300.9)
    assert segmented(segmenter, image, Prompt(box=box)).bounding_box == (101, 60, 2850, 2301)
    with pytest.raises(ImageTooLargeError, match="smaller box"):
        segmented(segmenter, image, Prompt(box=box), limits=ImageLimits(max_pixels=1_000_000))


def test_a_point_gives_the_object_and_what_else_it_may_mean(tmp_path: Path) -> None:
    # it takes all that looks alike: in a large crop both objects
    sam = Segmenter(*write_sam(tmp_path))
    image = blank_image(800, 800)
    image[376:424, 376:424] = image[376:424, 504:552] = OBJECT_RGB
    seen = segmented(sam, image, Prompt(points=((392.0, 392.0, True),)))
    assert is_rectangle(full_mask(seen, image), (376, 376, 424, 424))
    assert seen.bounding_box == (376, 376, 424, 424)
    assert seen.alternatives[0].bounding_box == (376, 376, 552, 424)
    assert segmented(sam, image, Prompt(box=(370.0, 370.0, 430.0, 430.0))).alternatives == ()
