from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import onnx
import pytest

from tests.models import blank_image, write_detector, write_other_model
from tests.sam_models import (
    EMPTY,
    FULL,
    OBJECT,
    keep_weights_beside,
    write_efficient_sam,
    write_sam,
    write_sam2,
    write_transformers,
)
from vehanchor.errors import (
    ImageTooLargeError,
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
    PromptError,
    ProviderUnavailableError,
)
from vehanchor.imagery.raster import Window, open_raster
from vehanchor.options import ImageLimits
from vehanchor.segmentation.contracts import MaskLogits, SamContract
from vehanchor.segmentation.segmenter import Prompt, Segmentation, Segmenter, crop_window, load_segmenter, place_mask
from vehanchor.segmentation.shape import mask_bounds

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tests.sam_models import SamFiles

OBJECT_RGB = (60, 130, 200)
OTHER_RGB = (200, 60, 60)
WRITERS: dict[str, Callable[[Path], SamFiles]] = {
    "sam, preprocessing in the graph": lambda folder: write_sam(folder, masks=[OBJECT, EMPTY, OBJECT, FULL],
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
def segmenter(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    """One of every contract."""
    return Segmenter(*WRITERS[request.param](tmp_path_factory.mktemp("sam")))


@pytest.fixture(scope="module")
def sam(tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    return Segmenter(*write_sam(tmp_path_factory.mktemp("sam")))


def _segment(segmenter: Segmenter, image: NDArray[np.uint8], prompt: Prompt, **options: Any) -> Segmentation:
    with open_raster(image) as raster:
        return segmenter.segment(raster, prompt, **options)


def _full_mask(found: Segmentation, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    full = np.zeros(image.shape[:2], dtype=bool)
    window = found.window
    full[window.y_px : window.y_px + window.height_px, window.x_px : window.x_px + window.width_px] = found.mask
    return full


def _is_rectangle(mask: NDArray[np.bool_], rectangle: tuple[int, int, int, int]) -> bool:
    """Whether a mask is a rectangle to the pixel, but for the corners that interpolation between cells rounds off."""
    bounds = mask_bounds(mask)
    area = (rectangle[2] - rectangle[0]) * (rectangle[3] - rectangle[1])
    return (
        bounds is not None
        and (bounds.x1, bounds.y1, bounds.x2, bounds.y2) == rectangle
        and int(mask.sum()) >= 0.98 * area
    )


def _picture(width: int, height: int, rectangle: tuple[int, int, int, int]) -> NDArray[np.uint8]:
    """A rectangle x1, y1, x2, y2 of the object's colour on a varied ground."""
    image = blank_image(width, height)
    image[: height // 2, :, 1] = 20
    image[:, : width // 3] = OTHER_RGB
    x1, y1, x2, y2 = rectangle
    image[y1:y2, x1:x2] = OBJECT_RGB
    return image


# --- every contract


# The crop is 256 px: at its upper left corner in the image's, within it, pushed back by the far edges. The object's
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
    image = _picture(600, 400, rectangle)
    x1, y1, x2, y2 = rectangle
    box = (x1 - 9.3, y1 - 6.1, x2 + 8.7, y2 + 5.5)
    found = _segment(segmenter, image, Prompt(box=box))
    assert found.window == Window(*window, 256, 256)
    assert _is_rectangle(_full_mask(found, image), rectangle)
    assert found.score == pytest.approx(0.9)


@pytest.mark.parametrize(
    "box",
    [
        (300.9, 150.1, 371.1, 190.9),  # sides close before or behind pixel centres: half a pixel either way shows
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
    found = _segment(segmenter, image, Prompt(box=box))
    bounds = mask_bounds(_full_mask(found, image))
    assert bounds is not None
    # pixels whose centres are inside
    expected = [int(np.ceil(side - 0.5)) for side in box]
    assert [bounds.x1, bounds.y1, bounds.x2, bounds.y2] == expected


def test_images_smaller_than_the_crop_are_seen_whole_whatever_their_shape(segmenter: Segmenter) -> None:
    for width, height in ((192, 96), (96, 192), (224, 224)):
        image = np.full((height, width, 3), OBJECT_RGB, np.uint8)
        box = (20.9, 12.1, 60.1, 80.9)
        found = _segment(segmenter, image, Prompt(box=box))
        assert found.window == Window(0, 0, width, height)
        bounds = mask_bounds(found.mask)
        assert bounds is not None
        assert [bounds.x1, bounds.y1, bounds.x2, bounds.y2] == [21, 12, 60, 81]


def test_a_point_gives_what_looks_like_it(segmenter: Segmenter) -> None:
    rectangle = (224, 64, 352, 128)  # sides on cells of 16 px (32 for SAM 3) of a 512 px crop
    image = _picture(512, 512, rectangle)
    found = _segment(segmenter, image, Prompt(points=((248.0, 100.0, True),)))
    assert _is_rectangle(_full_mask(found, image), rectangle)


def test_a_negative_point_takes_away_what_looks_like_it(segmenter: Segmenter) -> None:
    image = np.full((512, 512, 3), OBJECT_RGB, np.uint8)
    image[:, 256:] = np.array(OBJECT_RGB) + 20  # within the reach of the positive point's likeness
    points = ((100.0, 300.0, True), (400.0, 300.0, False))
    if segmenter.card.contract == "efficient_sam":
        with pytest.raises(PromptError, match="outside"):
            _segment(segmenter, image, Prompt(points=points))
        return
    image[:, 256:] = OTHER_RGB
    image[:, 224:256] = (130, 95, 130)
    found = _segment(segmenter, image, Prompt(points=((100.0, 300.0, True), (240.0, 300.0, False))))
    assert found.mask[:, :224].all()
    assert not found.mask[:, 224:].any()


def test_the_same_prompt_gives_the_same_mask_again_and_with_any_number_of_threads(segmenter: Segmenter) -> None:
    image = _picture(600, 400, (133, 171, 181, 267))
    prompt = Prompt(box=(120.0, 160.0, 190.0, 280.0))
    first = _segment(segmenter, image, prompt)
    one = Segmenter(segmenter.encoder_path, segmenter.decoder_path, threads=1)
    for other in (_segment(segmenter, image, prompt), _segment(one, image, prompt)):
        assert (other.mask == first.mask).all()
        assert other.score == first.score


def test_the_encoder_sees_colours_as_its_contract_says(segmenter: Segmenter, monkeypatch: pytest.MonkeyPatch) -> None:
    fed: list[NDArray[np.float32]] = []
    original = SamContract._run

    def spy(self: SamContract, session: Any, feeds: Any, run_options: Any) -> Any:
        fed.extend(feeds.values())
        return original(self, session, feeds, run_options)

    monkeypatch.setattr(SamContract, "_run", spy)
    _segment(segmenter, np.full((300, 300, 3), OBJECT_RGB, np.uint8), Prompt(box=(100.0, 100.0, 150.0, 150.0)))
    rgb, contract = np.array(OBJECT_RGB, dtype=np.float64), segmenter.card.contract
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


def test_the_card_names_both_files(segmenter: Segmenter) -> None:
    both = segmenter.encoder_path.read_bytes() + segmenter.decoder_path.read_bytes()
    card = segmenter.card
    assert card.sha256 == hashlib.sha256(both).hexdigest()
    assert card.name == segmenter.encoder_path.stem
    assert (card.min_score, card.mask_area_log_sd, card.licence) == (0.7, 0.1, None)


def test_the_contracts_are_told_by_their_names(tmp_path: Path) -> None:
    found = {}
    for number, (name, write) in enumerate(WRITERS.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        card = Segmenter(*write(folder)).card
        found[name] = card.contract, card.input_px
    assert found == {
        "sam, preprocessing in the graph": ("sam", 128),
        "sam, without preprocessing": ("sam", 128),
        "sam, without low_res_masks": ("sam", 128),
        "sam, another embedding": ("sam", 128),
        "sam, a fixed square": ("sam", 128),
        "sam2": ("sam2", 128),
        "transformers, SAM 2": ("transformers", 128),
        "transformers, SAM 3": ("transformers", 224),
        "efficient_sam": ("efficient_sam", 128),
        "efficient_sam, enlarging": ("efficient_sam", 512),
    }


# --- which of several masks


def test_a_box_takes_the_single_mask_and_a_point_the_best_of_the_others(tmp_path: Path) -> None:
    four = Segmenter(*write_sam(tmp_path, masks=[OBJECT, EMPTY, OBJECT, FULL], scores=[0.5, 0.7, 0.9, 0.8]))
    image = _picture(512, 512, (224, 64, 352, 128))
    on, off = (248.0, 100.0, True), (10.0, 500.0, False)
    assert _segment(four, image, Prompt(box=(220.0, 60.0, 360.0, 130.0))).score == pytest.approx(0.5)
    assert _segment(four, image, Prompt(points=(on,))).score == pytest.approx(0.9)
    assert _segment(four, image, Prompt(points=(on, off))).score == pytest.approx(0.5)


def test_without_a_single_mask_the_one_with_the_best_score_is_taken(tmp_path: Path) -> None:
    three = Segmenter(*write_sam2(tmp_path, masks=[FULL, EMPTY, OBJECT], scores=[0.6, 0.8, 0.7]))
    image = _picture(512, 512, (224, 64, 352, 128))
    for prompt in (Prompt(box=(220.0, 60.0, 360.0, 130.0)), Prompt(points=((248.0, 100.0, True),))):
        found = _segment(three, image, prompt)
        assert found.score == pytest.approx(0.8)
        assert not found.mask.any()


@pytest.mark.parametrize(("score", "told"), [(1.3, 1.0), (-0.2, 0.0), (float("nan"), 0.0)])
def test_scores_stay_within_0_and_1(tmp_path: Path, score: float, told: float) -> None:
    odd = Segmenter(*write_sam(tmp_path, scores=[score]))
    assert _segment(odd, _picture(300, 300, (100, 100, 150, 150)), Prompt(box=(95.0, 95.0, 155.0, 155.0))).score == told


# --- crops


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
        (Prompt(points=((1500.0, 1500.0, True),)), 512),
        (Prompt(points=((1200.0, 1500.0, True), (1600.0, 1500.0, False))), 800),
    ],
)
def test_the_crop_is_twice_the_prompt_and_at_least_256_px_or_512(sam: Segmenter, prompt: Prompt, side: int) -> None:
    image = blank_image(3000, 3000)
    x, y = (1500, 1500) if prompt.box is None else (int(prompt.box[0]), int(prompt.box[1]))
    image[y - 2 : y + 8, x - 302 : x + 8] = OBJECT_RGB
    if prompt.box is None:
        image[1490:1510, 1490 if len(prompt.points) == 1 else 1190 : 1510] = OTHER_RGB
    window = _segment(sam, image, prompt).window
    assert (window.width_px, window.height_px) == (side, side)


def test_the_crop_of_a_point_grows_until_the_object_is_in_it(sam: Segmenter) -> None:
    image = blank_image(3000, 2600)
    image[1100:1612, 1000:2200] = OBJECT_RGB
    found = _segment(sam, image, Prompt(points=((1500.0, 1300.0, True),)))
    assert found.window.width_px == 2048
    bounds = mask_bounds(_full_mask(found, image))
    assert bounds is not None
    assert (bounds.x1, bounds.y1, bounds.x2, bounds.y2) == pytest.approx((1000, 1100, 2200, 1612), abs=40)
    everything = _segment(sam, np.full((1300, 1300, 3), OBJECT_RGB, np.uint8), Prompt(points=((450.0, 650.0, True),)))
    assert everything.window == Window(0, 0, 1300, 1300)
    assert everything.mask.all()


def test_a_large_crop_is_read_in_strips_and_no_larger_than_the_limits(sam: Segmenter) -> None:
    image = np.full((2500, 3000, 3), OBJECT_RGB, np.uint8)
    box = (100.9, 60.1, 2850.1, 2300.9)
    bounds = mask_bounds(_segment(sam, image, Prompt(box=box)).mask)
    assert bounds is not None
    assert [bounds.x1, bounds.y1, bounds.x2, bounds.y2] == [101, 60, 2850, 2301]
    with pytest.raises(ImageTooLargeError, match="smaller box"):
        _segment(sam, image, Prompt(box=box), limits=ImageLimits(max_pixels=1_000_000))


def test_a_mask_is_placed_by_bilinear_interpolation_between_cell_centres() -> None:
    rng = np.random.default_rng(5)
    logits = np.asarray(cv2.GaussianBlur(rng.normal(size=(40, 30)), (0, 0), 2), dtype=np.float32)
    placed = place_mask(MaskLogits(logits, 1.0, (30 / 240, 40 / 320)), 240, 320)
    assert (placed != (cv2.resize(logits, (240, 320), interpolation=cv2.INTER_LINEAR) > 0)).mean() < 1e-3
    single = place_mask(MaskLogits(np.ones((1, 1), np.float32), 1.0, (0.01, 0.01)), 5, 7)
    assert single.all()


# --- files


def test_what_is_no_segmenter_is_refused_with_what_was_found(tmp_path: Path) -> None:
    encoder, decoder = write_sam(tmp_path)
    (tmp_path / "two").mkdir()
    encoder2, decoder2 = write_sam2(tmp_path / "two")
    other = write_other_model(tmp_path / "classifier.onnx")
    detector = write_detector(tmp_path / "detector.onnx")
    for pair in ((encoder, decoder2), (encoder2, decoder), (other, decoder), (detector, detector), (encoder, encoder)):
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
    with pytest.raises(ProviderUnavailableError):
        Segmenter(encoder, decoder, providers=["AbacusExecutionProvider"])
    with pytest.raises(InvalidParameterError, match="threads"):
        Segmenter(encoder, decoder, threads=0)


def test_a_size_that_no_shape_tells_must_be_in_the_metadata(tmp_path: Path) -> None:
    with pytest.raises(ModelContractError, match=r"vehanchor\.input_size_px"):
        Segmenter(*write_sam(tmp_path, embedding_stride=4))


def test_a_model_that_does_not_keep_its_own_shapes_is_a_contract_error(tmp_path: Path) -> None:
    encoder, _ = write_sam(tmp_path, embedding_stride=4, metadata={"vehanchor.input_size_px": "128"})
    (tmp_path / "other").mkdir()
    _, decoder = write_sam(tmp_path / "other")
    broken = Segmenter(encoder, decoder)
    with pytest.raises(ModelContractError, match="fails on"):
        _segment(broken, blank_image(300, 300), Prompt(box=(10.0, 10.0, 50.0, 50.0)))


def test_the_files_say_how_much_to_trust_them(tmp_path: Path) -> None:
    metadata = {
        "vehanchor.name": "small", "license": "Apache-2.0", "vehanchor.min_score": "0.6",
        "vehanchor.mask_area_log_sd": "0.05",
    }  # fmt: skip
    card = Segmenter(*write_sam(tmp_path, metadata=metadata)).card
    assert (card.name, card.licence, card.min_score, card.mask_area_log_sd) == ("small", "Apache-2.0", 0.6, 0.05)
    with pytest.raises(ModelContractError, match="mask_area_log_sd"):
        Segmenter(*write_sam(tmp_path, metadata={"vehanchor.mask_area_log_sd": "wide"}))


@pytest.mark.parametrize("suffix", ["_data", ".weights"])  # exporters' habit, and any other name
def test_weights_kept_beside_the_file_are_used_and_hashed(tmp_path: Path, suffix: str) -> None:
    encoder, decoder = write_sam2(tmp_path)
    plain = Segmenter(encoder, decoder).card.sha256
    beside = keep_weights_beside(decoder, suffix)
    outside = Segmenter(encoder, decoder)
    expected = hashlib.sha256(encoder.read_bytes() + decoder.read_bytes() + beside.read_bytes()).hexdigest()
    assert outside.card.sha256 == expected != plain
    image = _picture(600, 400, (133, 171, 181, 267))
    assert _segment(outside, image, Prompt(box=(118.0, 162.0, 212.0, 276.0))).mask.any()


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
    bounds = mask_bounds(
        _full_mask(_segment(Segmenter(encoder, decoder), image, Prompt(box=(300.9, 150.1, 371.1, 190.9))), image)
    )
    assert bounds is not None
    assert [bounds.x1, bounds.y1, bounds.x2, bounds.y2] == [301, 150, 371, 191]


def test_a_pair_of_files_is_loaded_once(tmp_path: Path) -> None:
    files = write_sam(tmp_path)
    assert load_segmenter(*files) is load_segmenter(*files)
    assert load_segmenter(*files, threads=1) is not load_segmenter(*files)


def test_replaced_files_are_loaded_anew(tmp_path: Path) -> None:
    files = write_sam(tmp_path)
    before = load_segmenter(*files)
    write_sam(tmp_path, scores=[0.4])
    after = load_segmenter(*files)
    assert after.card.sha256 == Segmenter(*files).card.sha256 != before.card.sha256
    prompt, image = Prompt(box=(95.0, 95.0, 155.0, 155.0)), _picture(300, 300, (100, 100, 150, 150))
    assert _segment(after, image, prompt).score == pytest.approx(0.4)


def test_relative_paths_are_other_files_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for name, score in (("one", 0.4), ("two", 0.5)):
        (tmp_path / name).mkdir()
        encoder, decoder = write_sam(tmp_path / name, scores=[score])
        monkeypatch.chdir(tmp_path / name)
        found.append(load_segmenter(Path(encoder.name), Path(decoder.name)))
    assert found[0].card.sha256 != found[1].card.sha256
