from __future__ import annotations

from functools import partial
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
    segment,
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


def _sam_with_single_mask(folder: Path) -> SamFiles:
    return write_sam(folder, masks=[OBJECT, EMPTY, OBJECT, FULL], scores=[0.9, 0.2, 0.8, 0.1])


def _sam_with_fine_embedding(folder: Path) -> SamFiles:
    metadata = {"vehanchor.input_size_px": "128"}
    return write_sam(folder, embedding_stride=4, metadata=metadata)


WRITERS: dict[str, Callable[[Path], SamFiles]] = {
    "sam, preprocessing in the graph": _sam_with_single_mask,
    "sam, without preprocessing": partial(write_sam, preprocess=False),
    "sam, without low_res_masks": partial(write_sam, low_res=False),
    "sam, another embedding": _sam_with_fine_embedding,
    "sam, a fixed square": partial(write_sam, fixed=True),
    "sam2": write_sam2,
    "transformers, SAM 2": write_transformers,
    "transformers, SAM 3": partial(write_transformers, sam3=True),
    "efficient_sam": write_efficient_sam,
    "efficient_sam, enlarging": partial(write_efficient_sam, input_px=512),
}


_EFFICIENT_SAM = [name for name in WRITERS if name.startswith("efficient_sam")]
_WITH_NEGATIVE_POINTS = [name for name in WRITERS if name not in _EFFICIENT_SAM]


@pytest.fixture(scope="module", params=WRITERS)
def segmenter(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Segmenter:
    """One segmenter of every contract."""
    write = WRITERS[request.param]
    return Segmenter(*write(tmp_path_factory.mktemp("sam")))


# The crop has 256 px. It lies in the corner of the image, inside the image, and pushed back by
# the far edges. The object's sides lie on cells of every model's grid: 8 px of the crop, 16 px for
# SAM 3.
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
    segmentation = segment(segmenter, image, Prompt(box=box))
    assert segmentation.window == Window(*window, 256, 256)
    assert is_rectangle(full_mask(segmentation, image), rectangle)
    assert segmentation.score == pytest.approx(0.9)


@pytest.mark.parametrize(
    "box",
    [
        # Sides close before or behind pixel centres: half a pixel either way shows.
        (300.9, 150.1, 371.1, 190.9),
        (300.1, 150.9, 371.9, 190.1),
        (10.9, 5.1, 40.1, 90.9),
        # The far edges push the crop back.
        (700.4, 500.6, 780.6, 580.4),
        # The crop is larger than the model's input, so it is reduced.
        (120.9, 90.1, 641.1, 560.9),
    ],
)
def test_the_sides_of_a_box_are_exact_to_a_fraction_of_a_pixel(
    segmenter: Segmenter, box: tuple[float, float, float, float]
) -> None:
    image = np.full((600, 800, 3), OBJECT_RGB, np.uint8)
    segmentation = segment(segmenter, image, Prompt(box=box))
    # The pixels whose centres are inside.
    expected = tuple(int(np.ceil(side - 0.5)) for side in box)
    assert segmentation.bounding_box == expected


@pytest.mark.parametrize("size", [(192, 96), (96, 192), (224, 224)])
def test_an_image_smaller_than_the_crop_is_used_whole(
    segmenter: Segmenter, size: tuple[int, int]
) -> None:
    width, height = size
    image = np.full((height, width, 3), OBJECT_RGB, np.uint8)
    segmentation = segment(segmenter, image, Prompt(box=(20.9, 12.1, 60.1, 80.9)))
    assert segmentation.window == Window(0, 0, width_px=width, height_px=height)
    assert segmentation.bounding_box == (21, 12, 60, 81)


# Its sides lie on cells of 16 px (32 px for SAM 3) of a crop of 512 px.
_OBJECT = (224, 64, 352, 128)
_BOX_AROUND = Prompt(box=(220.0, 60.0, 360.0, 130.0))
_ON_OBJECT = (248.0, 100.0, True)
_OFF_OBJECT = (10.0, 500.0, False)


def test_a_point_selects_the_pixels_that_look_like_it(segmenter: Segmenter) -> None:
    image = picture(512, 512, _OBJECT)
    segmentation = segment(segmenter, image, Prompt(points=(_ON_OBJECT,)))
    assert is_rectangle(full_mask(segmentation, image), _OBJECT)


@pytest.mark.parametrize("segmenter", _WITH_NEGATIVE_POINTS, indirect=True)
def test_a_negative_point_removes_the_pixels_that_look_like_it(segmenter: Segmenter) -> None:
    image = np.full((512, 512, 3), OBJECT_RGB, np.uint8)
    image[:, 224:256] = (130, 95, 130)
    image[:, 256:] = OTHER_RGB
    points = ((100.0, 300.0, True), (240.0, 300.0, False))
    segmentation = segment(segmenter, image, Prompt(points=points))
    assert segmentation.mask[:, :224].all()
    assert not segmentation.mask[:, 224:].any()


@pytest.mark.parametrize("segmenter", _EFFICIENT_SAM, indirect=True)
def test_efficient_sam_refuses_points_outside_the_object(segmenter: Segmenter) -> None:
    points = ((100.0, 300.0, True), (400.0, 300.0, False))
    with pytest.raises(PromptError, match="outside"):
        segment(segmenter, blank_image(512, 512), Prompt(points=points))


@pytest.mark.parametrize("threads", [None, 1])
def test_the_same_prompt_gives_the_same_mask_again(
    segmenter: Segmenter, threads: int | None
) -> None:
    image = picture(600, 400, (133, 171, 181, 267))
    prompt = Prompt(box=(120.0, 160.0, 190.0, 280.0))
    first = segment(segmenter, image, prompt)
    if threads is not None:
        runtime = Runtime(threads=threads)
        segmenter = Segmenter(segmenter.encoder_path, segmenter.decoder_path, runtime=runtime)
    again = segment(segmenter, image, prompt)
    assert (again.mask == first.mask).all()
    assert again.score == first.score


def test_the_encoder_gets_colours_as_its_contract_states(
    segmenter: Segmenter, monkeypatch: pytest.MonkeyPatch
) -> None:
    inputs: list[NDArray[np.float32]] = []
    original = SamContract._run

    def spy(self: SamContract, session: Any, feeds: Any) -> Any:
        inputs.extend(feeds.values())
        return original(self, session, feeds)

    monkeypatch.setattr(SamContract, "_run", spy)
    image = np.full((300, 300, 3), OBJECT_RGB, np.uint8)
    segment(segmenter, image, Prompt(box=(100.0, 100.0, 150.0, 150.0)))
    # The first input of a call is the encoder's picture.
    pixels = inputs[0]
    is_unplanar = pixels.ndim == 3
    colour = pixels[50, 40] if is_unplanar else pixels[0, :, 50, 40]
    rgb = np.array(OBJECT_RGB, dtype=np.float64)
    imagenet = (rgb / 255 - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    half = (rgb / 255 - 0.5) / 0.5
    is_sam3 = segmenter.card.input_px == 224
    expected = {
        "sam": rgb if is_unplanar else imagenet,
        "sam2": imagenet,
        "transformers": half if is_sam3 else imagenet,
        "efficient_sam": rgb / 255,
    }[segmenter.card.contract]
    assert colour == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("prompt", "score"),
    [
        (_BOX_AROUND, 0.95),
        (Prompt(points=(_ON_OBJECT, _OFF_OBJECT)), 0.95),
        # One point is ambiguous: the best of the other three masks.
        (Prompt(points=(_ON_OBJECT,)), 0.9),
    ],
)
def test_an_unambiguous_prompt_takes_the_single_mask(
    tmp_path: Path, prompt: Prompt, score: float
) -> None:
    files = write_sam(tmp_path, masks=[OBJECT, EMPTY, OBJECT, FULL], scores=[0.95, 0.7, 0.9, 0.8])
    image = picture(512, 512, _OBJECT)
    assert segment(Segmenter(*files), image, prompt).score == pytest.approx(score)


@pytest.mark.parametrize("prompt", [_BOX_AROUND, Prompt(points=(_ON_OBJECT,))])
def test_without_a_single_mask_the_best_score_is_taken(tmp_path: Path, prompt: Prompt) -> None:
    three = Segmenter(*write_sam2(tmp_path, masks=[FULL, EMPTY, OBJECT], scores=[0.6, 0.8, 0.7]))
    segmentation = segment(three, picture(512, 512, _OBJECT), prompt)
    assert segmentation.score == pytest.approx(0.8)
    assert not segmentation.mask.any()


@pytest.mark.parametrize(("score", "clipped"), [(1.3, 1.0), (-0.2, 0.0), (float("nan"), 0.0)])
def test_scores_stay_within_0_and_1(tmp_path: Path, score: float, clipped: float) -> None:
    segmenter = Segmenter(*write_sam(tmp_path, scores=[score]))
    image = picture(300, 300, (100, 100, 150, 150))
    prompt = Prompt(box=(95.0, 95.0, 155.0, 155.0))
    assert segment(segmenter, image, prompt).score == clipped


def test_an_input_size_without_fixed_shapes_must_be_in_the_metadata(tmp_path: Path) -> None:
    with pytest.raises(ModelContractError, match=r"vehanchor\.input_size_px"):
        Segmenter(*write_sam(tmp_path, embedding_stride=4))


def test_files_whose_shapes_do_not_match_are_a_contract_error(tmp_path: Path) -> None:
    encoder, _ = _sam_with_fine_embedding(tmp_path)
    (tmp_path / "other").mkdir()
    _, decoder = write_sam(tmp_path / "other")
    broken = Segmenter(encoder, decoder)
    with pytest.raises(ModelContractError, match="fails on"):
        segment(broken, blank_image(300, 300), Prompt(box=(10.0, 10.0, 50.0, 50.0)))


def test_half_precision_models_get_half_precision_inputs(tmp_path: Path) -> None:
    encoder, decoder = write_sam2(tmp_path)
    model = onnx.load(str(encoder))
    cast = onnx.helper.make_node("Cast", ["image_half"], ["image"], to=onnx.TensorProto.FLOAT)
    model.graph.node.insert(0, cast)
    model.graph.input[0].name = "image_half"
    model.graph.input[0].type.tensor_type.elem_type = onnx.TensorProto.FLOAT16
    # The name of the input identifies the contract, so the half-precision input gets it back.
    renamed = {"image_half": "image", "image": "image_full"}
    for node in model.graph.node:
        for names in (node.input, node.output):
            for k, name in enumerate(names):
                names[k] = renamed.get(name, name)
    model.graph.input[0].name = "image"
    onnx.save(model, str(encoder))
    image = np.full((600, 800, 3), OBJECT_RGB, np.uint8)
    segmentation = segment(
        Segmenter(encoder, decoder), image, Prompt(box=(300.9, 150.1, 371.1, 190.9))
    )
    assert segmentation.bounding_box == (301, 150, 371, 191)


def test_every_contract_has_a_name_of_its_own() -> None:
    names = {contract.name for contract in CONTRACTS}
    assert len(names) == len(CONTRACTS)


def test_every_contract_has_inputs_of_its_own() -> None:
    inputs = {(contract.encoder_inputs, contract.decoder_inputs) for contract in CONTRACTS}
    assert len(inputs) == len(CONTRACTS)


def test_the_error_about_unknown_files_describes_every_contract(tmp_path: Path) -> None:
    other = write_other_model(tmp_path / "classifier.onnx")
    with pytest.raises(ModelContractError) as caught:
        Segmenter(other, other)
    assert all(contract.described in str(caught.value) for contract in CONTRACTS)


def test_a_decoder_with_an_unknown_input_fits_no_contract(tmp_path: Path) -> None:
    encoder, decoder = write_sam(tmp_path)
    model = onnx.load(str(decoder))
    unknown = onnx.helper.make_tensor_value_info("text_prompt", onnx.TensorProto.FLOAT, [1])
    model.graph.input.append(unknown)
    onnx.save(model, str(decoder))
    with pytest.raises(ModelContractError, match="text_prompt"):
        Segmenter(encoder, decoder)
