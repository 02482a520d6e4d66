from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.models import write_detector, write_other_model
from tests.sam_models import (
    keep_weights_beside,
    write_sam,
    write_sam2,
)
from tests.skill.segmentation.objects import OBJECT_RGB, full_mask, picture, segmented
from vehanchor.errors import (
    ModelContractError,
    ModelNotFoundError,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.segmentation.contracts import SamContract
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.segmentation.contracts import Encoding


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
    image = picture(600, 400, (133, 171, 181, 267))
    assert segmented(outside, image, Prompt(box=(118.0, 162.0, 212.0, 276.0))).mask.any()


def test_neighbours_of_one_size_share_an_encoding_and_their_masks_are_as_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    segmenter = Segmenter(*write_sam(tmp_path, input_px=256))
    image = picture(900, 700, (102, 102, 138, 138))
    for x, y, side in ((162, 102, 36), (602, 402, 36), (302, 102, 180)):
        image[y : y + side, x : x + side] = OBJECT_RGB
    boxes = [(100.0, 100, 140, 140), (160.0, 100, 200, 140), (600.0, 400, 640, 440), (300.0, 100, 484, 284)]
    prompts = [Prompt(box=box) for box in boxes]
    alone = [full_mask(segmented(segmenter, image, prompt), image) for prompt in prompts]
    encode, crops = SamContract.encode, []

    def counted(contract: SamContract, crop: NDArray[np.uint8], crop_size: tuple[int, int], *others: Any) -> Encoding:
        crops.append(crop_size)
        return encode(contract, crop, crop_size, *others)

    monkeypatch.setattr(SamContract, "encode", counted)
    with open_raster(image) as raster:
        together = segmenter.segment_all(raster, prompts)
    assert crops == [(256, 256), (256, 256), (368, 368)]  # the second lies beside the first, the others far or large
    assert together[0].window == together[1].window
    for mask, found in zip(alone, together, strict=True):
        assert mask.any()
        assert (full_mask(found, image) == mask).all()
