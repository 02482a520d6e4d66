"""The segmenter's training code, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from research.scenes import render_scene  # noqa: E402
from research.training.segmenter.calibrate import (  # noqa: E402
    finished,
    see,
)
from research.training.segmenter.data import (  # noqa: E402
    BatchStream,
    MaskImage,
    MaskObject,
    cut,
    load_scenes,
    objects_of,
)
from research.training.segmenter.export import INPUT_PX, export, smoothed  # noqa: E402
from research.training.segmenter.network import (  # noqa: E402
    BOTTOM_RIGHT,
    TOP_LEFT,
    Prompt,
    Segmenter,
)
from research.training.segmenter.trials import Target  # noqa: E402 - PyTorch may be missing
from vehanchor.imagery.sources.opening import open_raster  # noqa: E402
from vehanchor.models.session import open_session  # noqa: E402
from vehanchor.segmentation.contracts import recognise_contract  # noqa: E402
from vehanchor.segmentation.prompt import Prompt as UserPrompt  # noqa: E402
from vehanchor.segmentation.segmenter import Segmenter as OnnxSegmenter  # noqa: E402

pytestmark = pytest.mark.slow


def _sample() -> MaskImage:
    """A bright L on dark ground, so that picture and mask can be compared."""
    mask = np.zeros((200, 240), np.uint16)
    mask[60:140, 80:120] = 3
    mask[110:140, 80:180] = 3
    image = np.full((200, 240, 3), 30, np.uint8)
    image[mask > 0] = 210
    return MaskImage("real", "building", group="group", image=image, mask=mask)


def _prompt(points: list[tuple[float, float]], labels: list[float], side: int) -> Prompt:
    cells = side // 2
    return Prompt(
        torch.tensor([points]),
        torch.tensor([labels]),
        torch.zeros(1, 1, cells, cells),
        torch.zeros(1),
    )


def test_crops_move_picture_and_mask_alike() -> None:
    sample = _sample()
    rng = np.random.default_rng(0)
    assert objects_of([sample]) == [MaskObject(0, 3, x0=80, y0=60, x1=180, y1=140)]
    for scale in (0.4, 0.8, 1.7):
        example = cut(rng, sample, 160, scale, (130.0, 100.0), 3)
        inner = example.mask > 0.98
        outer = example.mask < 0.02
        near = outer & (cv2.dilate(example.mask, np.ones((9, 9))) > 0.5)
        assert inner.sum() > 0.7 * 5000 * scale**2
        assert np.median(example.image[inner]) > 190
        assert np.percentile(example.image[near], 60) < 60


def test_batches_are_seeded_and_their_masks_touch_their_prompts(tmp_path: Path) -> None:
    render_scene(0.2, width_px=320, height_px=320, seed=4).write(tmp_path / "scene_4.jpg")
    images = [_sample(), *load_scenes(tmp_path)]
    first, second = (BatchStream(images, seed=5)[0] for _ in range(2))
    assert torch.equal(first.image, second.image)
    assert torch.equal(first.prompt.points, second.prompt.points)
    assert first.image.shape[2] == 2 * first.target.shape[2]
    boxed = (first.prompt.labels == TOP_LEFT).any(dim=1)
    assert boxed.float().mean() > 0.5
    assert (first.target.amax(dim=(1, 2, 3)) > 0.9).all()


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning",
    "ignore::torch.jit.TracerWarning",
    "ignore:Constant folding:UserWarning",
)
def test_an_exported_segmenter_gives_the_library_what_the_network_saw(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = Segmenter().eval()
    torch.save({"averaged": network.state_dict()}, tmp_path / "checkpoint.pt")
    offset = 0.25
    smoothing = 0.7
    calibration: dict[str, object] = {
        "min_score": 0.6,
        "mask_area_log_sd": 0.08,
        "mask_offset": offset,
        "mask_smoothing": smoothing,
    }
    encoder, decoder = export(tmp_path, tmp_path, calibration)
    assert encoder.stat().st_size + decoder.stat().st_size < 12e6
    segmenter = OnnxSegmenter(encoder, decoder)
    assert segmenter.card.name == "vehanchor-segmenter"
    image = np.random.default_rng(0).integers(0, 255, (256, 256, 3), dtype=np.uint8)
    with open_raster(image) as raster:
        segmentation = segmenter.segment(raster, UserPrompt(box=(60.0, 70.0, 180.0, 190.0)))
    pixels = torch.from_numpy(image.transpose(2, 0, 1).copy())[None].float() / 255
    with torch.no_grad():
        output = network(pixels, _prompt([(60, 70), (180, 190)], [TOP_LEFT, BOTTOM_RIGHT], 256))
        blurred = cv2.GaussianBlur(
            output.mask[0, 0].numpy(), (5, 5), smoothing, borderType=cv2.BORDER_REPLICATE
        )
        assert np.abs(smoothed(output.mask, smoothing)[0, 0].numpy() - blurred).max() < 1e-3
    large = cv2.resize(blurred, (256, 256), interpolation=cv2.INTER_LINEAR)
    assert segmentation.score == pytest.approx(float(output.iou), abs=1e-4)
    assert ((large + offset > 0) == segmentation.mask).mean() > 0.999
    (tmp_path / "bare").mkdir()
    bare = [open_session(path) for path in export(tmp_path, tmp_path / "bare", {})]
    target = Target("roof", "a", image, np.ones((256, 256), bool), (60.0, 70.0, 180.0, 190.0))
    view = see(recognise_contract(bare[0], bare[1], INPUT_PX), target)
    # The mask that the calibration judges.
    assert (finished(view, smoothing, offset)(target)[0] == segmentation.mask).mean() > 0.999
