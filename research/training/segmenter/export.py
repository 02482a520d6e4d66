"""Write a run as SAM-contract ONNX.

``python -m research.training.segmenter.export RUN FOLDER [--calibration JSON]``.

Makes ``segmenter-encoder.onnx`` (``input_image`` ``[256, 256, 3]`` RGB 0..255, preprocessing
inside) and ``segmenter-decoder.onnx`` with Meta's names. An image that is not square is scaled
until its longer side is 256 and padded with zeros at the right and the bottom, as for SAM; the
decoder undoes both from ``orig_im_size``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata, write_onnx
from research.training.segmenter.network import EMBEDDING_CHANNELS, STRIDE_PX, Prompt, Segmenter

INPUT_PX = 256
NAME = "vehanchor-segmenter"
# Reach of the smoothing: almost three standard deviations.
_REACH_CELLS = 2


class EncoderGraph(nn.Module):
    """``[s, s, 3]`` RGB in 0..255 to its embedding, ``[1, c, h, w]``."""

    def __init__(self, network: Segmenter) -> None:
        super().__init__()
        self.encoder = network.encoder

    def forward(self, input_image: Tensor) -> Tensor:
        """Encode."""
        embedding: Tensor = self.encoder(input_image.permute(2, 0, 1).unsqueeze(0) / 255.0)
        return embedding


def smoothed(logits: Tensor, sigma: float) -> Tensor:
    """Blur ``[b, 1, h, w]`` by a Gaussian of ``sigma`` cells, with the border repeated; 0: not."""
    if sigma == 0:
        return logits
    steps = torch.arange(-_REACH_CELLS, _REACH_CELLS + 1, dtype=logits.dtype, device=logits.device)
    line = torch.exp(-0.5 * (steps / sigma) ** 2)
    line = line / line.sum()
    padded = functional.pad(logits, (_REACH_CELLS,) * 4, mode="replicate")
    return functional.conv2d(padded, (line[:, None] * line[None, :])[None, None])


class DecoderGraph(nn.Module):
    """Decoder with SAM's signature: one mask a prompt, its logits smoothed and raised."""

    def __init__(
        self, network: Segmenter, side_px: int, mask_offset: float, mask_smoothing: float
    ) -> None:
        super().__init__()
        self.decoder = network.decoder
        self.side_px = side_px
        self.mask_offset = mask_offset
        self.mask_smoothing = mask_smoothing

    def forward(
        self,
        image_embeddings: Tensor,
        point_coords: Tensor,
        point_labels: Tensor,
        mask_input: Tensor,
        has_mask_input: Tensor,
        orig_im_size: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute masks, which are logits at the original size."""
        points = point_coords + 0.5  # SAM's coordinates are pixel indices
        found = self.decoder(
            image_embeddings, Prompt(points, point_labels, mask_input, has_mask_input)
        )
        logits = smoothed(found.mask, self.mask_smoothing) + self.mask_offset
        large = functional.interpolate(
            logits, (self.side_px, self.side_px), mode="bilinear", align_corners=False
        )
        size = orig_im_size.to(torch.float32)
        used = torch.floor(size * (self.side_px / torch.max(size)) + 0.5).to(torch.int64)
        large = large[:, :, : used[0], : used[1]]
        whole = orig_im_size.to(torch.int64)
        masks = functional.interpolate(
            large,
            [whole[0], whole[1]],  # type: ignore[list-item]  # traced
            mode="bilinear",
            align_corners=False,
        )
        return masks, found.iou, logits


def export(run: Path, folder: Path, calibration: dict[str, object]) -> tuple[Path, Path]:
    """Export a run; ``calibration`` (``calibrate.py``) becomes metadata of both files.

    Its ``mask_offset`` and ``mask_smoothing`` enter the graph as well.
    """
    network = Segmenter()
    load_average(network, run)
    encoder = folder / "segmenter-encoder.onnx"
    decoder = folder / "segmenter-decoder.onnx"
    cells = INPUT_PX // STRIDE_PX
    write_onnx(
        EncoderGraph(network),
        (torch.zeros(INPUT_PX, INPUT_PX, 3),),
        out=encoder,
        inputs=["input_image"],
        outputs=["image_embeddings"],
    )
    write_onnx(
        DecoderGraph(
            network,
            INPUT_PX,
            mask_offset=float(str(calibration.get("mask_offset", 0.0))),
            mask_smoothing=float(str(calibration.get("mask_smoothing", 0.0))),
        ),
        (
            torch.zeros(1, EMBEDDING_CHANNELS, cells, cells),
            torch.tensor([[[40.0, 50.0], [200.0, 180.0], [120.0, 100.0]]]),
            torch.tensor([[2.0, 3.0, 1.0]]),
            torch.zeros(1, 1, cells, cells),
            torch.zeros(1),
            torch.tensor([300.0, 400.0]),
        ),
        out=decoder,
        inputs=[
            "image_embeddings",
            "point_coords",
            "point_labels",
            "mask_input",
            "has_mask_input",
            "orig_im_size",
        ],
        outputs=["masks", "iou_predictions", "low_res_masks"],
        free={
            "point_coords": {1: "num_points"},
            "point_labels": {1: "num_points"},
            "masks": {2: "height", 3: "width"},
        },
    )
    metadata = {
        "description": "VehAnchor promptable segmenter",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.name": NAME,
        "vehanchor.input_size_px": str(INPUT_PX),
    }
    for key, value in calibration.items():
        metadata[f"vehanchor.{key}"] = value if isinstance(value, str) else json.dumps(value)
    for path in (encoder, decoder):
        write_metadata(path, metadata)
    return encoder, decoder


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--calibration", type=Path, help="JSON of vehanchor.* metadata, written by calibrate.py"
    )
    options = parser.parse_args()
    calibration = json.loads(options.calibration.read_text()) if options.calibration else {}
    for path in export(options.run, options.folder, calibration):
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
