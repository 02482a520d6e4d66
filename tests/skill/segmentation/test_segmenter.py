from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models import blank_image, write_detector, write_other_model
from tests.sam_models import SamFiles, write_sam, write_sam2
from tests.skill.segmentation.objects import OBJECT_RGB, full_mask, is_rectangle, segment
from vehanchor.errors import (
    ImageTooLargeError,
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
    PromptError,
)
from vehanchor.imagery.raster import Window
from vehanchor.options import Frame, ImageLimits
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.options.reading import FrameSize
from vehanchor.segmentation.prompt import MIN_BOX_PX, Prompt, prompt_in_image, read_prompt
from vehanchor.segmentation.segmenter import Segmentation, Segmenter

WHOLE = Frame()


def test_the_card_has_the_checksum_of_both_files(tmp_path: Path) -> None:
    segmenter = Segmenter(*write_sam(tmp_path))
    both = segmenter.encoder_path.read_bytes() + segmenter.decoder_path.read_bytes()
    assert segmenter.card.sha256 == hashlib.sha256(both).hexdigest()


def test_a_card_without_metadata_has_the_defaults(tmp_path: Path) -> None:
    segmenter = Segmenter(*write_sam(tmp_path))
    card = segmenter.card
    assert card.name == segmenter.encoder_path.stem
    assert (card.min_score, card.mask_area_log_sd, card.licence) == (0.7, 0.1, None)


def test_the_card_reads_the_metadata(tmp_path: Path) -> None:
    metadata = {
        "vehanchor.name": "small",
        "license": "Apache-2.0",
        "vehanchor.min_score": "0.6",
        "vehanchor.mask_area_log_sd": "0.05",
    }
    card = Segmenter(*write_sam(tmp_path, metadata=metadata)).card
    assert (card.name, card.licence) == ("small", "Apache-2.0")
    assert (card.min_score, card.mask_area_log_sd) == (0.6, 0.05)


def test_metadata_that_is_not_a_number_is_refused(tmp_path: Path) -> None:
    files = write_sam(tmp_path, metadata={"vehanchor.mask_area_log_sd": "wide"})
    with pytest.raises(ModelContractError, match="mask_area_log_sd"):
        Segmenter(*files)


@pytest.fixture(scope="module")
def sam(tmp_path_factory: pytest.TempPathFactory) -> SamFiles:
    return write_sam(tmp_path_factory.mktemp("sam"))


@pytest.fixture(scope="module")
def classifier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_other_model(tmp_path_factory.mktemp("other") / "classifier.onnx")


def test_files_that_are_not_a_segmenter_are_refused(
    sam: SamFiles, classifier: Path, tmp_path: Path
) -> None:
    encoder, decoder = sam
    encoder2, decoder2 = write_sam2(tmp_path)
    detector = write_detector(tmp_path / "detector.onnx")
    pairs = (
        (encoder, decoder2),
        (encoder2, decoder),
        (classifier, decoder),
        (detector, detector),
        (encoder, encoder),
    )
    for pair in pairs:
        with pytest.raises(ModelContractError, match="decoder in: ") as caught:
            Segmenter(*pair)
        assert caught.value.code == "model_contract"


def test_swapped_files_are_recognised(sam: SamFiles) -> None:
    encoder, decoder = sam
    with pytest.raises(ModelContractError, match="swapped"):
        Segmenter(decoder, encoder)


def test_the_outputs_of_an_unknown_file_are_listed(sam: SamFiles, classifier: Path) -> None:
    with pytest.raises(ModelContractError, match="logits"):
        Segmenter(sam[0], classifier)


def test_a_file_that_is_not_a_model_is_named(sam: SamFiles, tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(ModelContractError, match=r"text\.onnx"):
        Segmenter(tmp_path / "text.onnx", sam[1])


def test_a_missing_file_is_named(sam: SamFiles, tmp_path: Path) -> None:
    with pytest.raises(ModelNotFoundError, match="missing"):
        Segmenter(sam[0], tmp_path / "missing.onnx")


def test_a_box_is_read_as_numbers() -> None:
    box: Any = (1, np.float32(2), "3", 4.5)
    assert read_prompt(box, None) == Prompt(box=(1.0, 2.0, 3.0, 4.5))


def test_points_are_read_as_numbers_on_the_object_by_default() -> None:
    prompt = read_prompt(None, [(1, 2), (3, 4, False), (5, 6, True)])
    assert prompt.points == ((1.0, 2.0, True), (3.0, 4.0, False), (5.0, 6.0, True))
    assert prompt.box is None


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
def test_an_invalid_prompt_is_refused_without_an_image(box: Any, points: Any, message: str) -> None:
    with pytest.raises(PromptError, match=message) as caught:
        read_prompt(box, points)
    assert caught.value.code == "invalid_prompt"
    assert isinstance(caught.value, InvalidParameterError)


def test_a_box_just_beyond_the_image_is_clipped() -> None:
    box = Prompt(box=(-0.9, -0.5, 60.9, 40.3))
    clipped = prompt_in_image(box, WHOLE, PixelGrid(60, 40))
    assert clipped == Prompt(box=(0.0, 0.0, 60.0, 40.0))


def test_a_box_just_beyond_the_frame_is_clipped() -> None:
    box = Prompt(box=(-0.9, 0.0, 30.9, 20.0))
    clipped = prompt_in_image(box, Frame(FrameSize(30, 20)), PixelGrid(60, 40))
    assert clipped == Prompt(box=(0.0, 0.0, 60.0, 40.0))


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
def test_a_prompt_outside_the_image_is_refused(prompt: Prompt, frame: Frame, message: str) -> None:
    with pytest.raises(PromptError, match=message):
        prompt_in_image(prompt, frame, PixelGrid(60, 40))


def test_the_crop_of_a_box_has_twice_its_longer_side(segmenter: Segmenter) -> None:
    prompt = Prompt(box=(1200.0, 1500.0, 1500.0, 1600.0))
    window = segment(segmenter, blank_image(3000, 3000), prompt).window
    assert (window.width_px, window.height_px) == (600, 600)


def test_the_crop_of_a_small_box_has_256_px(segmenter: Segmenter) -> None:
    prompt = Prompt(box=(1500.0, 1500.0, 1510.0, 1505.0))
    window = segment(segmenter, blank_image(3000, 3000), prompt).window
    assert (window.width_px, window.height_px) == (256, 256)


def test_the_crop_of_a_point_grows_until_it_contains_the_object(segmenter: Segmenter) -> None:
    image = blank_image(3000, 2600)
    image[1100:1612, 1000:2200] = OBJECT_RGB
    segmentation = segment(segmenter, image, Prompt(points=((1500.0, 1300.0, True),)))
    assert segmentation.window.width_px == pytest.approx(2 * 1200, rel=0.05)
    assert segmentation.alternatives == ()
    assert segmentation.bounding_box == pytest.approx((1000, 1100, 2200, 1612), abs=40)


def test_the_crop_of_a_point_grows_to_the_whole_image(segmenter: Segmenter) -> None:
    image = np.full((1300, 1300, 3), OBJECT_RGB, np.uint8)
    segmentation = segment(segmenter, image, Prompt(points=((450.0, 650.0, True),)))
    assert segmentation.window == Window(0, 0, width_px=1300, height_px=1300)
    assert segmentation.mask.all()


_LARGE_BOX = Prompt(box=(100.9, 60.1, 2850.1, 2300.9))


def test_a_large_crop_is_read_in_strips(segmenter: Segmenter) -> None:
    image = np.full((2500, 3000, 3), OBJECT_RGB, np.uint8)
    assert segment(segmenter, image, _LARGE_BOX).bounding_box == (101, 60, 2850, 2301)


def test_a_crop_above_the_limit_is_refused(segmenter: Segmenter) -> None:
    image = np.full((2500, 3000, 3), OBJECT_RGB, np.uint8)
    with pytest.raises(ImageTooLargeError, match="smaller box"):
        segment(segmenter, image, _LARGE_BOX, limits=ImageLimits(max_pixels=1_000_000))


@pytest.fixture(scope="module")
def two_objects() -> NDArray[np.uint8]:
    """Two objects that look alike; the test's segmenter finds both in a large crop."""
    image = blank_image(800, 800)
    image[376:424, 376:424] = OBJECT_RGB
    image[376:424, 504:552] = OBJECT_RGB
    return image


@pytest.fixture(scope="module")
def of_a_point(sam: SamFiles, two_objects: NDArray[np.uint8]) -> Segmentation:
    return segment(Segmenter(*sam), two_objects, Prompt(points=((392.0, 392.0, True),)))


def test_a_point_names_the_object_around_it(
    of_a_point: Segmentation, two_objects: NDArray[np.uint8]
) -> None:
    assert is_rectangle(full_mask(of_a_point, two_objects), (376, 376, 424, 424))
    assert of_a_point.bounding_box == (376, 376, 424, 424)


def test_a_point_has_the_other_objects_as_alternatives(of_a_point: Segmentation) -> None:
    assert of_a_point.alternatives[0].bounding_box == (376, 376, 552, 424)


def test_a_box_has_no_alternatives(sam: SamFiles, two_objects: NDArray[np.uint8]) -> None:
    prompt = Prompt(box=(370.0, 370.0, 430.0, 430.0))
    assert segment(Segmenter(*sam), two_objects, prompt).alternatives == ()
