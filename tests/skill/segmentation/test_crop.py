from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.models import blank_image
from tests.sam_models import (
    write_sam,
)
from tests.skill.segmentation.objects import OBJECT_RGB, OTHER_RGB, full_mask, segmented
from vehanchor.errors import (
    ImageTooLargeError,
)
from vehanchor.imagery.raster import Window
from vehanchor.options import ImageLimits
from vehanchor.segmentation.contracts import MaskLogits, SamContract
from vehanchor.segmentation.crop import crop_window, place_mask
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmenter
from vehanchor.segmentation.shape import mask_bounds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.segmentation.contracts import Encoding


@pytest.fixture(scope="module")
def sam(tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    return Segmenter(*write_sam(tmp_path_factory.mktemp("sam")))


@pytest.mark.parametrize(
    ("prompt", "side", "expected"),
    [
        (Prompt(box=(500.0, 400.0, 520.0, 410.0)), 256, Window(382, 277, 256, 256)),
        (Prompt(box=(0.0, 0.0, 20.0, 10.0)), 256, Window(0, 0, 256, 256)),
        (Prompt(box=(980.0, 780.0, 1000.0, 800.0)), 256, Window(744, 544, 256, 256)),
        (Prompt(box=(0.0, 0.0, 1000.0, 800.0)), 2000, Window(0, 0, 1000, 800)),
        (Prompt(points=((100.0, 100.0, True), (700.0, 300.0, False))), 1200, Window(0, 0, 1000, 800)),
    ],
)
def test_the_crop_is_a_square_around_the_prompt_inside_the_image(prompt: Prompt, side: int, expected: Window) -> None:
    assert crop_window(prompt, 1000, 800, side) == expected


@pytest.mark.parametrize(
    ("prompt", "side"),
    [
        (Prompt(box=(1500.0, 1500.0, 1510.0, 1505.0)), 256),
        (Prompt(box=(1200.0, 1500.0, 1500.0, 1600.0)), 600),
    ],
)
def test_the_crop_of_a_box_has_twice_its_side_and_at_least_256_px(sam: Segmenter, prompt: Prompt, side: int) -> None:
    window = segmented(sam, blank_image(3000, 3000), prompt).window
    assert (window.width_px, window.height_px) == (side, side)


@pytest.mark.parametrize(
    ("points", "object_px", "limits", "sides"),
    [
        (((1500.0, 1500.0, True),), (32, 32), {}, [128, 256, 512, 1024, 256]),
        (((1500.0, 1500.0, True),), (32, 32), {"max_pixels": 300_000}, [128, 256, 512, 256]),
        (((1500.0, 1500.0, True),), (160, 160), {}, [128, 256, 512, 1024, 320]),  # the last is that of its box
        (((1500.0, 1500.0, True), (1400.0, 1500.0, False)), (32, 32), {}, [200, 400, 800, 256]),
        (((1500.0, 1500.0, True), (900.0, 1500.0, False)), (96, 96), {}, [1200, 256]),
    ],
)
def test_points_are_tried_in_crops_of_several_sizes_and_their_box_in_its_own(
    sam: Segmenter,
    monkeypatch: pytest.MonkeyPatch,
    points: tuple[tuple[float, float, bool], ...],
    object_px: tuple[int, int],
    limits: dict[str, int],
    sides: list[int],
) -> None:
    image = blank_image(3000, 3000)
    width, height = object_px
    image[1500 - height // 2 : 1500 + height // 2, 1500 - width // 2 : 1500 + width // 2] = OBJECT_RGB
    image[1480:1520, 880:920] = image[1480:1520, 1380:1420] = OTHER_RGB
    encode, crops = SamContract.encode, []

    def counted(contract: SamContract, crop: NDArray[np.uint8], crop_size: tuple[int, int]) -> Encoding:
        crops.append(crop_size[0])
        return encode(contract, crop, crop_size)

    monkeypatch.setattr(SamContract, "encode", counted)
    found = segmented(sam, image, Prompt(points=points), limits=ImageLimits(**limits))
    assert crops[:-1] == sides[:-1]
    assert crops[-1] == pytest.approx(sides[-1], rel=0.1)
    assert found.mask.sum() == pytest.approx(width * height, rel=0.3)


def test_the_crop_of_a_point_grows_until_the_object_is_in_it(sam: Segmenter) -> None:
    image = blank_image(3000, 2600)
    image[1100:1612, 1000:2200] = OBJECT_RGB
    found = segmented(sam, image, Prompt(points=((1500.0, 1300.0, True),)))
    assert found.window.width_px == pytest.approx(2 * 1200, rel=0.05)
    assert found.alternatives == ()
    bounds = mask_bounds(full_mask(found, image))
    assert bounds is not None
    assert (bounds.x1, bounds.y1, bounds.x2, bounds.y2) == pytest.approx((1000, 1100, 2200, 1612), abs=40)
    everything = segmented(sam, np.full((1300, 1300, 3), OBJECT_RGB, np.uint8), Prompt(points=((450.0, 650.0, True),)))
    assert everything.window == Window(0, 0, 1300, 1300)
    assert everything.mask.all()


def test_a_large_crop_is_read_in_strips_and_no_larger_than_the_limits(sam: Segmenter) -> None:
    image = np.full((2500, 3000, 3), OBJECT_RGB, np.uint8)
    box = (100.9, 60.1, 2850.1, 2300.9)
    bounds = mask_bounds(segmented(sam, image, Prompt(box=box)).mask)
    assert bounds is not None
    assert [bounds.x1, bounds.y1, bounds.x2, bounds.y2] == [101, 60, 2850, 2301]
    with pytest.raises(ImageTooLargeError, match="smaller box"):
        segmented(sam, image, Prompt(box=box), limits=ImageLimits(max_pixels=1_000_000))


def test_a_mask_is_placed_by_bilinear_interpolation_between_cell_centres() -> None:
    rng = np.random.default_rng(5)
    logits = np.asarray(cv2.GaussianBlur(rng.normal(size=(40, 30)), (0, 0), 2), dtype=np.float32)
    placed = place_mask(MaskLogits(logits, 1.0, (30 / 240, 40 / 320)), 240, 320)
    assert (placed != (cv2.resize(logits, (240, 320), interpolation=cv2.INTER_LINEAR) > 0)).mean() < 1e-3
    single = place_mask(MaskLogits(np.ones((1, 1), np.float32), 1.0, (0.01, 0.01)), 5, 7)
    assert single.all()
