"""Train the verifier, after ``research.training.verifier.mine``.

``python -m research.training.verifier.train RUN``.

Writes ``RUN/verifier.onnx``: ``chips`` ``[n, 3, 48, 48]`` float32 in 0..1 to ``logit`` ``[n]``.
Resumes from ``RUN/checkpoint.pt`` when it exists.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

from research.training.logistic import area
from research.training.loop import Recipe, Schedule, train
from research.training.onnx_file import write_onnx
from research.training.verifier.data import ChipStream, load, middle
from research.training.verifier.network import VerifierNet
from vehanchor.detection.verifier import CHIP_PX

_RATE = 2e-3
_BATCH = 96
# Labels are wrong now and then.
_SMOOTHING = 0.02


def losses(
    network: nn.Module, batch: tuple[Tensor, Tensor], device: torch.device
) -> Mapping[str, Tensor]:
    """Cross-entropy of the logit."""
    chips, car = (part.to(device) for part in batch)
    target = car * (1 - 2 * _SMOOTHING) + _SMOOTHING
    return {"entropy": binary_cross_entropy_with_logits(network(chips.float().div(255.0)), target)}


def export(network: VerifierNet, out: Path) -> None:
    """Write a network as ONNX."""
    example = torch.zeros(2, 3, CHIP_PX, CHIP_PX)
    write_onnx(
        network,
        (example,),
        out=out,
        inputs=["chips"],
        outputs=["logit"],
        free={"chips": {0: "n"}, "logit": {0: "n"}},
    )


def logits(network: VerifierNet, chips: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Compute the logits of a network for stored chips, ``[n]``."""
    out = []
    with torch.no_grad():
        for start in range(0, len(chips), 512):
            cut = np.ascontiguousarray(middle(chips[start : start + 512]).transpose(0, 3, 1, 2))
            out.append(network(torch.from_numpy(cut).float().div(255.0)).numpy())
    return np.concatenate(out).astype(np.float64)


def report(
    car: NDArray[np.bool_], sets: NDArray[np.str_], scores: NDArray[np.float64]
) -> list[str]:
    """Tabulate area under the ROC curve and false alarms left at 95 % of the hits, by set."""
    lines = []
    for name in (*np.unique(sets), "all"):
        in_set = np.ones(len(sets), bool) if name == "all" else sets == name
        hits = scores[in_set & car]
        false = scores[in_set & ~car]
        if len(hits) > 5 and len(false):
            left = np.mean(false > np.percentile(hits, 5))
            counts = f"{name:13s} {len(hits):5d} hits {len(false):5d} false"
            lines.append(f"{counts}, AUC {area(hits, false):.3f}, left at 95 %: {left:.3f}")
        elif len(false):
            lines.append(f"{name:13s} {len(false):5d} false, median {np.median(false):+.2f}")
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    candidates, held_out = (load(options.run / f"{name}.npz") for name in ("train", "held_out"))
    recipe = Recipe(
        Schedule(options.steps, _RATE, warm_up=100), _BATCH, average=0.995, log_every=100
    )
    network = train(
        VerifierNet(), ChipStream(candidates, options.seed), losses, recipe, options.run
    )
    trained = cast("VerifierNet", network)
    export(trained, options.run / "verifier.onnx")
    held_out_logits = logits(trained, held_out.chips)
    detector = np.log(held_out.scores / (1 - held_out.scores))
    for name, scores in (
        ("detector", detector),
        ("verifier", held_out_logits),
        ("sum", detector + held_out_logits),
    ):
        print(name)
        print("\n".join(report(held_out.car, held_out.sets, scores)), flush=True)


if __name__ == "__main__":
    main()
