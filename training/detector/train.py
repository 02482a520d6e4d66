"""Train the detector: ``python -m training.detector.train --steps 7000 --run runs/detector``.

Resumes from ``RUN/checkpoint.pt`` when it exists; uses a GPU when there is one.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import math
import time
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from training.detector.data import CropStream, Target, load_scenes, load_train_images
from training.detector.loss import detection_loss
from training.detector.network import VehicleNet
from training.detector.warm_start import load_exported

_WARM_UP_STEPS = 200
_EMA_DECAY = 0.998
_CHECKPOINT_EVERY = 200
_STATISTICS_CROPS = 64


def learning_rate(step: int, steps: int, peak: float) -> float:
    """Linear warm-up, then a cosine down to 2 % of the peak."""
    if step < _WARM_UP_STEPS:
        return peak * (step + 1) / _WARM_UP_STEPS
    progress = (step - _WARM_UP_STEPS) / max(1, steps - _WARM_UP_STEPS)
    return peak * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/vehicles"))
    parser.add_argument("--scenes", type=Path, help="folder of rendered scenes (see render_scenes.py)")
    parser.add_argument("--run", type=Path, default=Path("runs/detector"))
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument("--start", type=Path, help="exported detector to begin with instead of random weights")
    parser.add_argument("--rate", type=float, default=2e-3, help="peak learning rate")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bfloat16", action="store_true", help="mixed precision: faster where the processor has it")
    options = parser.parse_args()

    options.run.mkdir(parents=True, exist_ok=True)
    checkpoint_path = options.run / "checkpoint.pt"
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(options.seed)
    images = load_train_images(options.data)
    if options.scenes:
        images += load_scenes(options.scenes)
    print(f"{len(images)} images, {sum(len(i.boxes) for i in images)} cars", flush=True)

    network = VehicleNet().to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stub
    if options.start:
        sample = CropStream(images, seed=options.seed)
        crops = torch.stack([crop for crop, _ in itertools.islice(sample, _STATISTICS_CROPS)])
        load_exported(network, options.start, crops.to(device).float().div(255.0))
    averaged = copy.deepcopy(network).eval()
    decay = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    optimizer = torch.optim.AdamW([{"params": decay, "weight_decay": 0.02}, {"params": plain, "weight_decay": 0.0}])
    first = 0
    if checkpoint_path.exists():
        state = torch.load(checkpoint_path, map_location=device, weights_only=True)
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        first = state["step"]
        print(f"resumed at step {first}", flush=True)

    stream = CropStream(images, seed=options.seed * 1_000_003 + first)
    loader = iter(DataLoader(stream, batch_size=options.batch, num_workers=1, prefetch_factor=4))
    network.train()
    sums, started = [0.0, 0.0], time.monotonic()
    for step in range(first, options.steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, options.steps, options.rate)
        image, raw = next(loader)
        target = Target(*(part.to(device) for part in raw))
        pixels = image.to(device).float().div(255.0).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=options.bfloat16):
            prediction = network(pixels)
        heat, shape = detection_loss(prediction, target)
        optimizer.zero_grad(set_to_none=True)
        (heat + shape).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        with torch.no_grad():
            keep = min(_EMA_DECAY, (step + 1) / (step + 10))
            for slow, fast in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
                if slow.dtype.is_floating_point:
                    slow.lerp_(fast, 1 - keep)
                else:
                    slow.copy_(fast)
        sums[0] += heat.item()
        sums[1] += shape.item()
        done = step + 1
        if done % 50 == 0:
            pace = (time.monotonic() - started) / (done - first)
            print(f"{done} heat {sums[0] / 50:.4f} shape {sums[1] / 50:.4f} {pace:.2f} s/step", flush=True)
            sums = [0.0, 0.0]
        if done % _CHECKPOINT_EVERY == 0 or done == options.steps:
            state = {
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
                "step": done,
            }
            torch.save(state, checkpoint_path.with_suffix(".tmp"))
            checkpoint_path.with_suffix(".tmp").replace(checkpoint_path)


if __name__ == "__main__":
    main()
