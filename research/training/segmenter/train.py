"""Train the segmenter.

``python -m research.training.segmenter.train --steps 17500 --run runs/segmenter --scenes
runs/scenes``.

Resumes from ``RUN/checkpoint.pt`` when it exists; uses a GPU when there is one
(``research/training/loop.py``).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from research.training.loop import Recipe, Schedule, train
from research.training.segmenter.data import Batch, BatchStream, is_dev, load_scenes, load_segments
from research.training.segmenter.loss import segmentation_loss
from research.training.segmenter.network import Prompt, Segmentation, Segmenter

_PEAK_RATE = 2e-3


def losses(network: nn.Module, batch: Batch, device: torch.device) -> Mapping[str, Tensor]:
    """Compute the loss of the masks and of the predicted IoU."""
    prompt = Prompt(*(part.to(device) for part in batch.prompt))
    image = batch.image.to(device).float().div(255.0).contiguous(memory_format=torch.channels_last)
    outputs = network(image, prompt)
    loss = segmentation_loss(
        Segmentation(outputs.mask.float(), outputs.iou.float()), batch.target.to(device)
    )
    return {"mask": loss.mask, "iou": loss.iou}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    parser.add_argument("--scenes", type=Path, help="folder of `render_scenes detector`")
    parser.add_argument("--run", type=Path, default=Path("runs/segmenter"))
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--bfloat16", action="store_true", help="mixed precision: faster where the processor has it"
    )
    options = parser.parse_args()

    torch.manual_seed(options.seed)
    images = [image for image in load_segments(options.data, "train") if not is_dev(image.group)]
    if options.scenes:
        images += load_scenes(options.scenes)
    stream = BatchStream(images, seed=options.seed)
    print(f"{len(images)} masks, objects: {stream.counts()}", flush=True)
    network = Segmenter()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    schedule = Schedule(options.steps, _PEAK_RATE, warm_up=80, last=0.01)
    recipe = Recipe(schedule, batch=None, average=0.995, bfloat16=options.bfloat16, log_every=25)
    train(network, stream, losses, recipe, options.run)


if __name__ == "__main__":
    main()
