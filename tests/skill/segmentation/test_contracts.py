from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import pytest

from tests.models import blank_image, write_other_model
from tests.sam_models import (
    EMPTY,
    FULL,
    OBJECT,
    write_efficient_sam,
    write_sam,
    write_sam2,
    write_transformers,
)
from tests.skill.segmentation.objects import (
    OBJECT_RGB,
    OTHER_RGB,
    full_mask,
    is_rectangle,
    picture,
    segmented,
)
from vehanchor.errors import ModelContractError, PromptError
from vehanchor.imagery.raster import Window
from vehanchor.models.runtime import Runtime
from vehanchor.segmentation.contracts import CONTRACTS, SamContract
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tests.sam_models import SamFiles


WRITERS: dict[str, Callable[[Path], SamFiles]] = {
    "sam, preprocessing in the "
        "graph": lambda folder: write_sam(folder, masks=[OBJECT, EMPTY, OBJECT, FULL],
                                                                scores=[0.9, 0.2, 0.8, 0.1]),
    "sam, without preprocessing": lambda folder: write_sam(folder, preprocess=False),
    "sam, without low_res_masks": lambda folder: write_sam(folder, low_res=False),
    "sam, another embedding": lambda folder: write_sam(
        folder, embedding_stride=4, metadata={"vehanchor.input_size_px": "128"}
    ),
    "sam, a fixed square": lambda folder: write_sam(folder, fixed=True),
    "sam2": write_sam2,
    "transformers, SAM 2": write_transformers,
    "transformers, SAM 3": lambda folder: write_transformers(folder, sam3=True),
    "efficient_sam": write_efficient_sam,
    "efficient_sam, enlarging": lambda folder: write_efficient_sam(folder, input_px=512),
}  # fmt: skip


@pytest.fixture(scope="module", params=WRITERS)
def segmenter(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Segmenter:
    """One of every contract."""
    return Segmenter(*WRITERS[request.param](tmp_path_factory.mktemp("sam")))


# The crop is 256 px: at its upper left corner in the image's, within it, pushed back by the far
# edges. The object's
# sides lie on cells of every model's grid, 8 px of the crop, 16 px for SAM 3's.
@pytest.mark.parametrize(
    ("window", "rectangle"),
    [
        ((0, 0), (96, 80, 144, 176)),
        ((37, 91), (133, 171, 197, 267)),
        ((344, 144), (504, 272, 552, 368)),
    ],
)
def test_a_box_gives_the_exact_pixels_of_the_object_in_it(
    segmenter: Segmenter, window: tuple[int, int], rectangle: tuple[int, int, int, int]
) -> None:
    image = picture(600, 400, rectangle)
    x1, y1, x2, y2 = rectangle
    box = (x1 - 9.3, y1 - 6.1, x2 + 8.7, y2 + 5.5)
    found = segmented(segmenter, image, Prompt(box=box))
    assert found.window == Window(*window, 256, 256)
    assert is_rectangle(full_mask(found, image), rectangle)
    assert found.score == pytest.approx(0.9)


@pytest.mark.parametrize(
    "box",
    [
        # sides close before or behind pixel centres: half a pixel either way shows
        (300.9, 150.1, 371.1, 190.9),
        (300.1, 150.9, 371.9, 190.1),
        (10.9, 5.1, 40.1, 90.9),
        (700.4, 500.6, 780.6, 580.4),  # the crop is pushed back by the far edges
        (120.9, 90.1, 641.1, 560.9),  # a crop larger than the model's input: reduced
    ],
)
def test_the_sides_of_a_box_are_read_to_a_fraction_of_a_pixel(
    segmenter: Segmenter, box: tuple[float, float, float, float]
) -> None:
    image = np.full((600, 800, 3), OBJECT_RGB, np.uint8)
    found = segmented(segmenter, image, Prompt(box=box))
    # pixels whose centres are inside
    assert found.bounding_box == tuple(int(np.ceil(side - 0.5)) for side in box)


def test_images_smaller_than_the_crop_are_seen_whole_whatever_their_shape(
    segmenter: Segmenter,
) -> None:
    for width, height in ((192, 96), (96, 192), (224, 224)):
        image = np.full((height, width, 3), OBJECT_RGB, np.uint8)
        box = (20.9, 12.1, 60.1, 80.9)
        found = segmented(segmenter, image, Prompt(box=box))
        assert found.window == Window(0, 0, width_px=width, height_px=height)
        assert found.bounding_box == (21, 12, 60, 81)


def test_a_point_gives_what_looks_like_it(segmenter: Segmenter) -> None:
    rectangle = (224, 64, 352, 128)  # sides on cells of 16 px (32 for SAM 3) of a 512 px crop
    image = picture(512, 512, rectangle)
    found = segmented(segmenter, image, Prompt(points=((248.0, 100.0, True),)))
    assert is_rectangle(full_mask(found, image), rectangle)


def test_a_negative_point_takes_away_what_looks_like_it(segmenter: Segmenter) -> None:
    image = np.full((512, 512, 3), OBJECT_RGB, np.uint8)
    image[:, 256:] = np.array(OBJECT_RGB) + 20  # within the reach of the positive point's likeness
    points = ((100.0, 300.0, True), (400.0, 300.0, False))
    if segmenter.card.contract == "efficient_sam":
        with pytest.raises(PromptError, match="outside"):
            segmented(segmenter, image, Prompt(points=points))
        return
    image[:, 256:] = OTHER_RGB
    image[:, 224:256] = (130, 95, 130)
    found = segmented(
        segmenter, image, Prompt(points=((100.0, 300.0, True), (240.0, 300.0, False)))
    )
    assert found.mask[:, :224].all()
    assert not found.mask[:, 224:].any()


def test_the_same_prompt_gives_the_same_mask_again_and_with_any_number_of_threads(
    segmenter: Segmenter,
) -> None:
    image = picture(600, 400, (133, 171, 181, 267))
    prompt = Prompt(box=(120.0, 160.0, 190.0, 280.0))
    first = segmented(segmenter, image, prompt)
    one = Segmenter(segmenter.encoder_path, segmenter.decoder_path, runtime=Runtime(threads=1))
    for other in (segmented(segmenter, image, prompt), segmented(one, image, prompt)):
        assert (other.mask == first.mask).all()
        assert other.score == first.score


def test_the_encoder_sees_colours_as_its_contract_says(
    segmenter: Segmenter, monkeypatch: pytest.MonkeyPatch
) -> None:
    fed: list[NDArray[np.float32]] = []
    original = SamContract._run

    def spy(self: SamContract, session: Any, feeds: Any) -> Any:
        fed.extend(feeds.values())
        return original(self, session, feeds)

    monkeypatch.setattr(SamContract, "_run", spy)
    segmented(
        segmenter,
        np.full((300, 300, 3), OBJECT_RGB, np.uint8),
        Prompt(box=(100.0, 100.0, 150.0, 150.0)),
    )
    rgb = np.array(OBJECT_RGB, dtype=np.float64)
    contract = segmenter.card.contract
    imagenet = (rgb / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    half = (rgb / 255 - 0.5) / 0.5
    expected = {
        "sam": rgb if fed[0].ndim == 3 else imagenet,
        "sam2": imagenet,
        "transformers": half if segmenter.card.input_px == 224 else imagenet,
        "efficient_sam": rgb / 255,
    }[contract]
    colour = fed[0][50, 40] if fed[0].ndim == 3 else fed[0][0, :, 50, 40]
    assert colour == pytest.approx(expected, abs=1e-4)


def test_a_box_takes_the_single_mask_and_a_point_the_best_of_the_others(tmp_path: Path) -> None:
    four = Segmenter(
        *write_sam(tmp_path, masks=[OBJECT, EMPTY, OBJECT, FULL], scores=[0.95, 0.7, 0.9, 0.8])
    )
    image = picture(512, 512, (224, 64, 352, 128))
    on = (248.0, 100.0, True)
    off = (10.0, 500.0, False)
    assert segmented(four, image, Prompt(box=(220.0, 60.0, 360.0, 130.0))).score == pytest.approx(
        0.95
    )
    assert segmented(four, image, Prompt(points=(on,))).score == pytest.approx(0.9)
    assert segmented(four, image, Prompt(points=(on, off))).score == pytest.approx(0.95)


def test_without_a_single_mask_the_one_with_the_best_score_is_taken(tmp_path: Path) -> None:
    three = Segmenter(*write_sam2(tmp_path, masks=[FULL, EMPTY, OBJECT], scores=[0.6, 0.8, 0.7]))
    image = picture(512, 512, (224, 64, 352, 128))
    for prompt in (Prompt(box=(220.0, 60.0, 360.0, 130.0)), Prompt(points=((248.0, 100.0, True),))):
        found = segmented(three, image, prompt)
        assert found.score == pytest.approx(0.8)
        assert not found.mask.any()


@pytest.mark.parametrize(("score", "told"), [(1.3, 1.0), (-0.2, 0.0), (float("nan"), 0.0)])
def test_scores_stay_within_0_and_1(tmp_path: Path, score: float, told: float) -> None:
    odd = Segmenter(*write_sam(tmp_path, scores=[score]))
    assert (
        segmented(
            odd, picture(300, 300, (100, 100, 150, 150)), Prompt(box=(95.0, 95.0, 155.0, 155.0))
        ).score
        == told
    )


def test_a_size_that_no_shape_tells_must_be_in_the_metadata(tmp_path: Path) -> None:
    with pytest.raises(ModelContractError, match=r"vehanchor\.input_size_px"):
        Segmenter(*write_sam(tmp_path, embedding_stride=4))


def test_a_model_that_does_not_keep_its_own_shapes_is_a_contract_error(tmp_path: Path) -> None:
    encoder, _ = write_sam(
        tmp_path, embedding_stride=4, metadata={"vehanchor.input_size_px": "128"}
    )
    (tmp_path / "other").mkdir()
    _, decoder = write_sam(tmp_path / "other")
    broken = Segmenter(encoder, decoder)
    with pytest.raises(ModelContractError, match="fails on"):
        segmented(broken, blank_image(300, 300), Prompt(box=(10.0, 10.0, 50.0, 50.0)))


def test_half_precision_models_are_fed_in_their_own_type(tmp_path: Path) -> None:
    encoder, decoder = write_sam2(tmp_path)
    model = onnx.load(str(encoder))
    cast = onnx.helper.make_node("Cast", ["image_half"], ["image"], to=onnx.TensorProto.FLOAT)
    model.graph.node.insert(0, cast)
    model.graph.input[0].name = "image_half"
    model.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT16
    for node in model.graph.node:  # the contract is told by the name: give it back
        for names in (node.input, node.output):
            for k, name in enumerate(names):
                names[k] = {"image_half": "image", "image": "image_full"}.get(name, name)
    model.graph.input[0].name = "image"
    onnx.save(model, str(encoder))
    image = np.full((600, 800, 3), OBJECT_RGB, np.uint8)
    found = segmented(Segmenter(encoder, decoder), image, Prompt(box=(300.9, 150.1, 371.1, 190.9)))
    assert found.bounding_box == (301, 150, 371, 191)


def test_every_contract_has_a_name_and_inputs_of_its_own_and_is_told_to_whoever_brings_another(
    tmp_path: Path,
) -> None:
    assert len({kind.name for kind in CONTRACTS}) == len(CONTRACTS)
    assert len({(kind.encoder_inputs, kind.decoder_inputs) for kind in CONTRACTS}) == len(CONTRACTS)
    other = write_other_model(tmp_path / "classifier.onnx")
    with pytest.raises(ModelContractError) as caught:
        Segmenter(other, other)
    assert all(kind.described in str(caught.value) for kind in CONTRACTS)


def test_a_decoder_that_asks_for_what_nobody_can_give_keeps_no_contract(tmp_path: Path) -> None:
    encoder, decoder = write_sam(tmp_path)
    model = onnx.load(str(decoder))
    model.graph.input.append(
        onnx.helper.make_tensor_value_info("text_prompt", onnx.TensorProto.FLOAT, [1])
    )
    onnx.save(model, str(decoder))
    with pytest.raises(ModelContractError, match="text_prompt"):
        Segmenter(encoder, decoder)
