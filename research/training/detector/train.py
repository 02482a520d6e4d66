"""Train the detector.

``python -m research.training.detector.train --steps 7000 --run runs/detector``.

Resumes from ``RUN/checkpoint.pt`` when it exists; uses a GPU when there is one
(``research/training/loop.py``). ``--without estonia`` leaves sets out: what such a detector finds
there is what a new place gets.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from research.training.detector.data import CropStream, Target, load_scenes, load_train_images
from research.training.detector.loss import detection_loss
from research.training.detector.network import VehicleNet
from research.training.detector.scenery import load_scenery
from research.training.loop import Recipe, Schedule, train
from research.training.warm_start import load_exported

_STATISTICS_CROPS = 64


def losses(
    network: nn.Module, batch: tuple[Tensor, Target], device: torch.device
) -> Mapping[str, Tensor]:
    """Compute the loss of the heat map and of the boxes' numbers."""
    image, raw = batch
    pixels = image.to(device).float().div(255.0).contiguous(memory_format=torch.channels_last)
    heat, shape = detection_loss(network(pixels), Target(*(part.to(device) for part in raw)))
    return {"heat": heat, "shape": shape}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenes", type=Path, help="folder of `render_scenes detector`")
    parser.add_argument("--run", type=Path, default=Path("runs/detector"))
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument(
        "--start", type=Path, help="exported detector to begin with instead of random weights"
    )
    parser.add_argument("--rate", type=float, default=2e-3, help="peak learning rate")
    parser.add_argument(
        "--held", type=float, default=0.0, help="share of the steps after which the rate falls"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", default="", help="sets to leave out, comma between")
    parser.add_argument(
        "--bfloat16", action="store_true", help="mixed precision: faster where the processor has it"
    )
    options = parser.parse_args()

    torch.manual_seed(options.seed)
    images = load_train_images(options.data / "vehicles") + load_scenery(options.data)
    if options.scenes:
        images += load_scenes(options.scenes)
    images = [image for image in images if image.set not in options.without.split(",")]
    print(f"{len(images)} images, {sum(len(i.boxes) for i in images)} cars", flush=True)
    stream = CropStream(images, seed=options.seed)
    network = VehicleNet()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if options.start:
        crops = torch.stack([stream[k][0] for k in range(_STATISTICS_CROPS)])
        load_exported(network, options.start, crops.float().div(255.0))
    schedule = Schedule(options.steps, options.rate, held=options.held)
    train(
        network,
        stream,
        losses,
        Recipe(schedule, options.batch, bfloat16=options.bfloat16),
        options.run,
    )


if __name__ == "__main__":
    main()
