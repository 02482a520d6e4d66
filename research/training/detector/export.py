"""Write the trained network as ONNX in the Ultralytics OBB layout.

``python -m research.training.detector.export RUN OUT.onnx``.

The graph ends where Ultralytics' does, ``[1, 4 + 1 + 1, anchors]`` with cx, cy, w, h, score, angle,
so one decoder reads both. Scores of cells that are not the highest of their 3 x 3 neighbourhood are
set to zero inside the graph.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from research.training.detector.network import STRIDE_PX, VehicleNet
from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata, write_onnx


class LengthCorrection(nn.Module):
    """Correct log lengths by a factor that runs linearly in the log between knots.

    Beyond the knots it is constant.
    """

    def __init__(self, knots: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        self.knots = [(math.log(length), math.log(factor)) for length, factor in knots]

    def forward(self, log_length: Tensor) -> Tensor:
        """Add the correction."""
        out = log_length + (self.knots[0][1] if self.knots else 0.0)
        for (start, before), (end, after) in pairwise(self.knots):
            share = ((log_length - start) / (end - start)).clamp(0.0, 1.0)
            out = out + (after - before) * share
        return out


class UltralyticsLayout(nn.Module):
    """Network with its dense output decoded to ``[b, 6, anchors]`` and corrected lengths.

    That is pairs of a length in pixels and the factor on it, lengths rising (see ``calibrate.py``);
    none for no change.
    """

    def __init__(
        self, network: VehicleNet, length_correction: Sequence[tuple[float, float]] = ()
    ) -> None:
        super().__init__()
        self.network = network
        self.correction = LengthCorrection(length_correction)

    def forward(self, images: Tensor) -> Tensor:
        """Decode heat map and shape to boxes in input pixels."""
        heat, shape = self.network(images)
        score = heat.sigmoid()
        score = score * (functional.max_pool2d(score, 3, 1, 1) == score)
        rows = torch.arange(score.shape[2], device=score.device, dtype=score.dtype).view(
            1, 1, -1, 1
        )
        cols = torch.arange(score.shape[3], device=score.device, dtype=score.dtype).view(
            1, 1, 1, -1
        )
        x = (cols + 0.5 + shape[:, 0:1]) * STRIDE_PX
        y = (rows + 0.5 + shape[:, 1:2]) * STRIDE_PX
        # Every cell around a centre was trained to tell the same box: their mean is steadier than
        # the peak alone.
        trust = heat.sigmoid()
        total = functional.avg_pool2d(trust, 3, 1, 1).clamp(1e-6)
        steady = functional.avg_pool2d(shape[:, 2:] * trust, 3, 1, 1) / total
        logs = steady[:, 0:2].clamp(0.0, 7.0)
        log_length = self.correction(logs[:, 0:1])
        log_width = logs[:, 1:2]
        sides = torch.cat([log_length, log_width], dim=1).exp()
        angle = 0.5 * torch.atan2(steady[:, 3:4], steady[:, 2:3])
        return torch.cat([x, y, sides, score, angle], dim=1).flatten(2)


def export(run: Path, out: Path, calibration: dict[str, object]) -> None:
    """Write a run as one ONNX file.

    Args:
        run: of ``train.py``.
        out: the file.
        calibration: of ``calibrate.py``; becomes metadata, its ``length_correction`` part of the
            graph.
    """
    network = VehicleNet()
    load_average(network, run)
    correction = cast("Sequence[tuple[float, float]]", calibration.get("length_correction", ()))
    write_onnx(
        UltralyticsLayout(network, correction),
        (torch.zeros(1, 3, 256, 256),),
        out=out,
        inputs=["images"],
        outputs=["output0"],
        free={
            "images": {0: "batch", 2: "height", 3: "width"},
            "output0": {0: "batch", 2: "anchors"},
        },
    )
    metadata = {
        "description": "VehAnchor oriented-box vehicle detector",
        "author": "VehAnchor",
        "license": LICENCE,
        "task": "obb",
        "stride": "32",
        "batch": "1",
        "imgsz": "[1024, 1024]",
        "names": "{0: 'small vehicle'}",
        "end2end": "False",
    }
    for key, value in calibration.items():
        metadata[f"vehanchor.{key}"] = value if isinstance(value, str) else json.dumps(value)
    write_metadata(out, metadata)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--calibration", type=Path, help="JSON of vehanchor.* metadata, written by calibrate.py"
    )
    options = parser.parse_args()
    calibration = json.loads(options.calibration.read_text()) if options.calibration else {}
    export(options.run, options.out, calibration)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
