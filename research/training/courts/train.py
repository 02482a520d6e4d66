"""Train the network that proposes courts.

``python -m research.training.courts.train RUN SCENES OUT.onnx``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from research.training.courts.data import CropStream, load_empty, load_real, load_rendered
from research.training.courts.network import CELL_PX, CourtNet
from research.training.loop import Recipe, Schedule, load_average, train
from research.training.onnx_file import LICENCE, write_metadata, write_onnx

if TYPE_CHECKING:
    from collections.abc import Mapping

_RATE = 4e-3
_BATCH = 24
_POSE_WEIGHT = 1.0


def losses(
    network: nn.Module, batch: tuple[Tensor, Tensor, Tensor], device: torch.device
) -> Mapping[str, Tensor]:
    """Compute the focal loss of the heats and the absolute error of the poses at their peaks.

    Source: Zhou et al., Objects as Points, 2019.
    """
    pixels, targets, weights = (part.to(device) for part in batch)
    outputs = network(pixels)
    heat = outputs[:, :2]
    heats = targets[:, :2]
    share = torch.sigmoid(heat)
    peaks = heats > 0.8
    hit = functional.logsigmoid(heat) * (1 - share) ** 2
    miss = functional.logsigmoid(-heat) * share**2 * (1 - heats) ** 4
    n_peaks = peaks.sum().clamp(min=1)
    focal = -(torch.where(peaks, hit, miss) * weights).sum() / n_peaks
    near = (heats.amax(dim=1, keepdim=True) > 0.5).float()
    n_near = near.sum().clamp(min=1)
    pose_errors = (outputs[:, 2:] - targets[:, 2:]).abs()
    pose = (pose_errors * near).sum() / n_near
    return {"heat": focal, "pose": _POSE_WEIGHT * pose}


class Exported(nn.Module):
    """A network that takes pixels of 0 to 255 and gives shares instead of log odds."""

    def __init__(self, network: CourtNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, tiles: Tensor) -> Tensor:
        """Compute ``[n, 5, h / 8, w / 8]`` from ``[n, 3, h, w]`` uint8."""
        seen = self.network(tiles.float() / 255.0)
        shares = torch.sigmoid(seen[:, :2])
        poses = seen[:, 2:]
        return torch.cat([shares, poses], dim=1)


def export(network: CourtNet, out: Path) -> None:
    """Write a network as ONNX."""
    write_onnx(
        Exported(network),
        (torch.zeros(1, 3, 12 * CELL_PX, 16 * CELL_PX, dtype=torch.uint8),),
        out=out,
        inputs=["tiles"],
        outputs=["courts"],
        free={"tiles": {0: "n", 2: "h", 3: "w"}, "courts": {0: "n", 2: "rows", 3: "columns"}},
    )
    write_metadata(out, {"name": "courts", "license": LICENCE})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("scenes", type=Path, help="folder of `render_scenes courts`")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--rate", type=float, default=_RATE)
    parser.add_argument("--start", type=Path, help="run whose weights to begin with")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    groups = load_real(options.data), load_rendered(options.scenes), load_empty(options.data)
    print(*(f"{len(group)} pictures" for group in groups), flush=True)
    options.run.mkdir(parents=True, exist_ok=True)
    network = CourtNet()
    if options.start:
        load_average(network, options.start)
    recipe = Recipe(Schedule(options.steps, options.rate), _BATCH, average=0.995, workers=0)
    trained = train(network, CropStream(groups, options.seed), losses, recipe, options.run)
    export(cast("CourtNet", trained), options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
