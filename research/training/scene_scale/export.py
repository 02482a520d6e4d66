"""Write a trained network as ONNX.

``python -m research.training.scene_scale.export RUN OUT.onnx --calibration FILE.json``.

``tiles`` ``[n, 3, 160, 160]`` uint8 RGB to ``log_probs`` ``[n, BINS]`` float32. How the library
makes one density of them (``vehanchor.detection.scene_scale``) is in the metadata.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata, write_onnx
from research.training.scene_scale.bins import FIRST_LOG_GSD, LOG_STEP
from research.training.scene_scale.network import SceneScaleNet
from vehanchor.detection.scene_scale import TILE_PX

_NAME = "scene-scale"


class FromBytes(nn.Module):
    """A network that takes pixels of 0 to 255."""

    def __init__(self, network: SceneScaleNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, tiles: Tensor) -> Tensor:
        """Compute log-probabilities ``[n, BINS]`` of tiles ``[n, 3, TILE_PX, TILE_PX]`` uint8."""
        return cast("Tensor", self.network(tiles.float() / 255.0))


def export(network: SceneScaleNet, out: Path, calibration: dict[str, float]) -> None:
    """Write a network and its calibration (fields of ``SceneCalibration``) as one file."""
    write_onnx(
        FromBytes(network),
        (torch.zeros(2, 3, TILE_PX, TILE_PX, dtype=torch.uint8),),
        out=out,
        inputs=["tiles"],
        outputs=["log_probs"],
        free={"tiles": {0: "n"}, "log_probs": {0: "n"}},
    )
    metadata = {
        "name": _NAME,
        "license": LICENCE,
        "vehanchor.scene_bins": json.dumps([FIRST_LOG_GSD, LOG_STEP]),
        "vehanchor.scene_calibration": json.dumps(calibration),
    }
    write_metadata(out, metadata)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--calibration", type=Path, help="JSON written by calibrate.py")
    options = parser.parse_args()
    network = SceneScaleNet()
    load_average(network, options.run)
    calibration = json.loads(options.calibration.read_text()) if options.calibration else {}
    export(network, options.out, calibration)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
