"""Train the segmenter: ``python -m training.segmenter.train --minutes 26 --run runs/segmenter --scenes runs/scenes``.

Give ``--minutes`` of wall time or ``--steps``; the learning rate falls to its end over either. Resumes from
``RUN/checkpoint.pt`` when it exists; uses a GPU when there is one.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from training.segmenter.data import BatchStream, is_dev, load_scenes, load_segments
from training.segmenter.loss import segmentation_loss
from training.segmenter.network import Prompt, Segmentation, Segmenter

_PEAK_RATE = 2e-3
_WARM_UP_STEPS = 80
_EMA_DECAY = 0.995
_CHECKPOINT_EVERY = 100
_LOG_EVERY = 25


def learning_rate(step: int, progress: float) -> float:
    """Linear warm-up, then a cosine down to 1 % of the peak as ``progress`` goes from 0 to 1."""
    warm = min(1.0, (step + 1) / _WARM_UP_STEPS)
    return _PEAK_RATE * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    parser.add_argument("--scenes", type=Path, help="folder of rendered scenes (training/detector/render_scenes.py)")
    parser.add_argument("--run", type=Path, default=Path("runs/segmenter"))
    until = parser.add_mutually_exclusive_group(required=True)
    until.add_argument("--steps", type=int)
    until.add_argument("--minutes", type=float, help="of wall time spent in steps, all resumed parts together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bfloat16", action="store_true", help="mixed precision: faster where the processor has it")
    options = parser.parse_args()

    options.run.mkdir(parents=True, exist_ok=True)
    checkpoint_path = options.run / "checkpoint.pt"
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.manual_seed(options.seed)
    images = [image for image in load_segments(options.data, "train") if not is_dev(image.group)]
    if options.scenes:
        images += load_scenes(options.scenes)

    network = Segmenter().to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stub
    averaged = copy.deepcopy(network).eval()
    decay = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    optimizer = torch.optim.AdamW([{"params": decay, "weight_decay": 0.02}, {"params": plain, "weight_decay": 0.0}])
    step, spent_before = 0, 0.0
    if checkpoint_path.exists():
        state = torch.load(checkpoint_path, map_location=device, weights_only=True)
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        step, spent_before = state["step"], state["spent_s"]
        print(f"resumed at step {step}", flush=True)

    stream = BatchStream(images, seed=options.seed * 1_000_003 + step)
    print(f"{len(images)} masks, objects: {stream.counts()}", flush=True)
    loader = iter(DataLoader(stream, batch_size=None, num_workers=1, prefetch_factor=8))
    network.train()
    sums, logged, started = [0.0, 0.0, 0.0], 0, time.monotonic()
    while True:
        spent = spent_before + time.monotonic() - started
        progress = step / options.steps if options.steps else spent / (60 * options.minutes)
        if progress >= 1:
            break
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(step, progress)
        batch = next(loader)
        prompt = Prompt(*(part.to(device) for part in batch.prompt))
        image = batch.image.to(device).float().div(255.0).contiguous(memory_format=torch.channels_last)
        with torch.autocast(device.type, torch.bfloat16, enabled=options.bfloat16):
            found = network(image, prompt)
        loss = segmentation_loss(Segmentation(found.mask.float(), found.iou.float()), batch.target.to(device))
        optimizer.zero_grad(set_to_none=True)
        (loss.mask + loss.iou).backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        step += 1
        with torch.no_grad():
            keep = min(_EMA_DECAY, step / (step + 9))
            for slow, fast in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
                if slow.dtype.is_floating_point:
                    slow.lerp_(fast, 1 - keep)
                else:
                    slow.copy_(fast)
        for k, part in enumerate(loss):
            sums[k] += part.item()
        logged += 1
        if step % _LOG_EVERY == 0:
            mask, iou, overlap = (part / logged for part in sums)
            print(
                f"{step} mask {mask:.4f} iou {iou:.4f} overlap {overlap:.3f} spent {spent / 60:.1f} min "
                f"progress {progress:.1%}",
                flush=True,
            )
            sums, logged = [0.0, 0.0, 0.0], 0
        if step % _CHECKPOINT_EVERY == 0:
            _save(checkpoint_path, network, averaged, optimizer, step, spent)
    _save(checkpoint_path, network, averaged, optimizer, step, spent)
    print(f"done at step {step} after {spent / 60:.1f} min", flush=True)


def _save(
    path: Path,
    network: Segmenter,
    averaged: Segmenter,
    optimizer: torch.optim.Optimizer,
    step: int,
    spent_s: float,
) -> None:
    state = {
        "network": network.state_dict(),
        "averaged": averaged.state_dict(),
        "optimizer": optimizer.state_dict(),
        "step": step,
        "spent_s": spent_s,
    }
    torch.save(state, path.with_suffix(".tmp"))
    path.with_suffix(".tmp").replace(path)


if __name__ == "__main__":
    main()
