"""The detector's training code, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnxruntime = pytest.importorskip("onnxruntime")

# PyTorch may be missing, so these follow importorskip.
from research.training.detector.calibrate import LengthPairs, length_correction  # noqa: E402
from research.training.detector.data import (  # noqa: E402 - PyTorch may be missing
    CROP_PX,
    TrainImage,
    draw_crop,
)
from research.training.detector.export import (  # noqa: E402
    LengthCorrection,
    UltralyticsLayout,
    export,
)
from research.training.detector.network import VehicleNet  # noqa: E402
from research.training.warm_start import load_exported  # noqa: E402
from vehanchor.detection.detector import Detector  # noqa: E402

pytestmark = pytest.mark.slow


def _sample() -> TrainImage:
    """Three grey cars on black, so that a crop's picture and its boxes can be compared."""
    import cv2

    from vehanchor.detection.boxes import box_corners

    boxes = np.array([[150.0, 120, 40, 16, 0.5], [260, 200, 38, 15, 2.0], [90, 240, 42, 17, 1.2]])
    image = np.zeros((320, 400, 3), np.uint8)
    for corners in box_corners(boxes):
        cv2.fillPoly(
            image, [np.round((corners - 0.5) * 256).astype(np.int32)], (200, 200, 200), shift=8
        )
    return TrainImage(
        "ucm", image, boxes=boxes, ignore=np.zeros((0, 4, 2)), clutter=np.zeros((0, 2))
    )


def test_crops_move_picture_and_boxes_alike() -> None:
    from vehanchor.detection.boxes import box_corners

    rng = np.random.default_rng(0)
    n_boxes = 0
    for _ in range(40):
        crop = draw_crop(rng, _sample())
        lit = crop.image[:, :, 0] > 100
        for box in crop.boxes:
            corners = box_corners(box[None])[0]
            if box[2] < 20 or (corners < 2).any() or (corners > CROP_PX - 2).any():
                continue
            rows, cols = np.mgrid[0:CROP_PX, 0:CROP_PX] + 0.5
            dx = cols - box[0]
            dy = rows - box[1]
            along = np.abs(dx * np.cos(box[4]) + dy * np.sin(box[4]))
            across = np.abs(-dx * np.sin(box[4]) + dy * np.cos(box[4]))
            inside = (along < box[2] / 2 - 1) & (across < box[3] / 2 - 1)
            ring = (
                (along < box[2] / 2 + 3)
                & (across < box[3] / 2 + 3)
                & ~((along < box[2] / 2 + 1) & (across < box[3] / 2 + 1))
            )
            assert lit[inside].mean() > 0.97
            assert lit[ring].mean() < 0.2
            n_boxes += 1
    assert n_boxes > 15


# The TorchScript exporter, which needs no onnxscript, warns.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_an_exported_network_gives_the_detector_what_the_network_saw(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = VehicleNet().eval()
    torch.save({"averaged": network.state_dict()}, tmp_path / "checkpoint.pt")
    path = tmp_path / "m.onnx"
    export(tmp_path, path, {"reference_length_m": 4.5, "length_range_px": "9,64"})
    detector = Detector(path)
    assert detector.card.reference_length_m == 4.5
    image = np.random.default_rng(0).integers(0, 255, (128, 160, 3), dtype=np.uint8)
    with torch.no_grad():
        tensor = (
            torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None].float() / 255
        )
        columns = UltralyticsLayout(network)(tensor)[0].numpy()
    output = onnxruntime.InferenceSession(path).run(None, {"images": tensor.numpy()})[0][0]
    np.testing.assert_allclose(output[[0, 1, 2, 3, 5]], columns[[0, 1, 2, 3, 5]], atol=1e-3)
    vehicles = detector.detect_tile(detector.prepared(image), 1e-6).vehicles
    boxes = vehicles.boxes
    scores = vehicles.scores
    # An untrained network has near ties.
    assert len(boxes) == (output[4] > 0).sum() == pytest.approx((columns[4] > 0).sum(), abs=5)
    assert scores.max() == pytest.approx(columns[4].max(), abs=1e-5)


def test_lengths_are_corrected_between_the_knots_and_beyond_them() -> None:
    lengths = torch.tensor([5.0, 10.0, 20.0, 40.0, 90.0])
    corrected_to = LengthCorrection([(10.0, 1.2), (40.0, 0.9)])(lengths.log()).exp() / lengths
    assert corrected_to.tolist() == pytest.approx(
        [1.2, 1.2, np.sqrt(1.2 * 0.9), 0.9, 0.9], rel=1e-5
    )
    assert LengthCorrection([])(lengths.log()).exp().tolist() == pytest.approx(
        lengths.tolist(), rel=1e-6
    )


def test_the_correction_is_the_inverse_of_the_bias() -> None:
    rng = np.random.default_rng(0)
    labelled = np.exp(rng.uniform(np.log(9), np.log(70), 20_000))
    detected = labelled * np.where(labelled < 20, 0.95, 1.02) * np.exp(rng.normal(0, 0.02, 20_000))
    factors = dict(length_correction(LengthPairs(detected, labelled, np.full(20_000, "cannes"))))
    assert factors[min(factors)] == pytest.approx(1 / 0.95, abs=0.01)
    assert factors[max(factors)] == pytest.approx(1 / 1.02, abs=0.01)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_network_started_from_a_file_computes_the_same(
    tmp_path: Path,
) -> None:
    torch.manual_seed(1)
    source = VehicleNet().train()
    crops = torch.rand(4, 3, 64, 64)
    with torch.no_grad():
        for _ in range(30):
            source(crops)  # normalisations that are not the identity
    source.eval()
    torch.save({"averaged": source.state_dict()}, tmp_path / "checkpoint.pt")
    export(tmp_path, tmp_path / "m.onnx", {})
    network = VehicleNet()
    load_exported(network, tmp_path / "m.onnx", crops)
    with torch.no_grad():
        ours = network.eval()(crops)
        theirs = source(crops)
    torch.testing.assert_close(ours.heat, theirs.heat, atol=2e-3, rtol=1e-3)
    torch.testing.assert_close(ours.shape, theirs.shape, atol=2e-3, rtol=1e-3)
    with torch.no_grad():  # and with the batch's own statistics, as in training
        torch.testing.assert_close(network.train()(crops).heat, theirs.heat, atol=5e-2, rtol=1e-2)
