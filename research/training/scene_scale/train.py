"""Train the scene-scale network.

``python -m research.training.scene_scale.train RUN``; resumes from ``RUN/checkpoint.pt``.

``--without estonia,estonia_port`` leaves sets out: what such a network says of them is what a new
place gets.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from research.training.detector.network import begin_with_detector
from research.training.loop import Recipe, Schedule, load_average, train
from research.training.scene_scale.data import SETS, CropStream, load_images, load_scenes
from research.training.scene_scale.network import SceneScaleNet, begin_with_exported

_RATE = 3e-3
_BATCH = 48


def losses(
    network: nn.Module, batch: tuple[Tensor, Tensor], device: torch.device
) -> Mapping[str, Tensor]:
    """Cross-entropy with the soft targets."""
    tiles, targets = (part.to(device) for part in batch)
    outputs = network(tiles.float().div(255.0).contiguous(memory_format=torch.channels_last))
    return {"entropy": -(targets * outputs).sum(dim=1).mean()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--scenes", type=Path, nargs="*", default=[], help="folders of rendered scenes to add"
    )
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rate", type=float, default=_RATE)
    parser.add_argument(
        "--held", type=float, default=0.3, help="share of the steps before the rate begins to fall"
    )
    begin = parser.add_mutually_exclusive_group()
    begin.add_argument("--start", type=Path, help="run whose weights to begin with")
    begin.add_argument(
        "--detector", type=Path, help="ONNX file of the detector, to begin with its encoder"
    )
    begin.add_argument(
        "--exported", type=Path, help="ONNX file of fewer bins whose weights to begin with"
    )
    parser.add_argument(
        "--frozen",
        type=int,
        default=0,
        help="so many parts keep their weights: the stem, then stages",
    )
    parser.add_argument("--without", default="", help=f"sets to leave out, among {', '.join(SETS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    images = load_images(
        options.data, without=[name for name in options.without.split(",") if name]
    )
    images += [scene for folder in options.scenes for scene in load_scenes(folder)]
    print(f"{len(images)} images, {sum(i.pixels.nbytes for i in images) / 1e9:.2f} GB", flush=True)
    stream = CropStream(images, options.seed)
    network = SceneScaleNet()
    if options.start:
        load_average(network, options.start)
    if options.detector:
        tiles = torch.stack([stream[k][0] for k in range(_BATCH)])
        begin_with_detector(network, options.detector, tiles.float().div(255.0))
    if options.exported:
        tiles = torch.stack([stream[k][0] for k in range(_BATCH)])
        begin_with_exported(network, options.exported, tiles.float().div(255.0))
    network.freeze(options.frozen)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    schedule = Schedule(
        options.steps, options.rate, warm_up=min(60, options.steps // 4 + 1), held=options.held
    )
    recipe = Recipe(schedule, _BATCH, average=0.99, checkpoint_every=50, log_every=25, workers=0)
    train(network, stream, losses, recipe, options.run)


if __name__ == "__main__":
    main()
