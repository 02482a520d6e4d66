"""Train the car verifier, after ``mine`` and ``paste``.

``python -m research.training.car_verifier.train RUN --steps N`` reads ``RUN/train`` (or ``--train-store``) and
``--stores``. It resumes from ``RUN/checkpoint.pt`` if that exists; a store may be added between two parts of a run. At
the end it writes ``RUN/car-verifier.onnx``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, smooth_l1_loss

from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.stream import Batch, ChipStream
from research.training.detector.network import begin_with_detector
from research.training.loop import Recipe, Schedule, train
from research.training.onnx_file import write_onnx
from research.training.warm_start import load_exported
from vehanchor.detection.car_verifier import CHIP_PX

_RATE = 1.5e-3
_BATCH = 64
_SMOOTHING = 0.02  # labels are wrong now and then
_TYPE_WEIGHT, _BOX_WEIGHT, _LENGTH_WEIGHT = 0.15, 0.25, 0.1
_SCALE = 0.1  # of boxes and log lengths: errors of this size count one


def losses(network: nn.Module, batch: Batch, device: torch.device) -> Mapping[str, Tensor]:
    """Cross-entropies of car and type, smooth L1 of box and length where these are known."""
    chip, car, kind, box, weight, log_length = (part.to(device) for part in batch)
    said = network(chip.float().div(255.0))
    logit, types, boxes, lengths = (part.float() for part in said)
    out = {"car": binary_cross_entropy_with_logits(logit, car * (1 - 2 * _SMOOTHING) + _SMOOTHING)}
    out["type"] = _TYPE_WEIGHT * _masked(cross_entropy(types, kind.clamp(min=0), reduction="none"), (kind >= 0).float())
    error = smooth_l1_loss(boxes / _SCALE, box / _SCALE, reduction="none", beta=0.5).mean(dim=1)
    out["box"] = _BOX_WEIGHT * _masked(error, weight)
    known = torch.isfinite(log_length)
    error = smooth_l1_loss(lengths / _SCALE, log_length.nan_to_num() / _SCALE, reduction="none", beta=0.5)
    out["length"] = _LENGTH_WEIGHT * _masked(error, known.float())
    return out


def _masked(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1.0)


class Exported(nn.Module):
    """The network with its four answers as the library reads them."""

    def __init__(self, network: CarVerifierNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, chips: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Logit, type logits, box correction, log length in metres."""
        said = self.network(chips)
        return said.logit, said.types, said.box, said.log_length_m


def export(network: CarVerifierNet, out: Path) -> None:
    """Write a network as ONNX: ``chips [n, 3, 96, 96]`` to ``logit``, ``types``, ``box``, ``log_length_m``."""
    names = ["logit", "types", "box", "log_length_m"]
    example = torch.zeros(2, 3, CHIP_PX, CHIP_PX)
    write_onnx(Exported(network), (example,), out, ["chips"], names, {name: {0: "n"} for name in ("chips", *names)})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--held", type=float, default=0.5, help="share of the steps before the rate falls")
    parser.add_argument("--stores", type=Path, nargs="*", default=[], help="folders beside RUN/train")
    parser.add_argument("--detector", type=Path, help="ONNX file of the detector, to begin with its encoder")
    parser.add_argument("--weights", type=Path, help="ONNX file of a car verifier, to train on")
    parser.add_argument("--rate", type=float, default=_RATE)
    parser.add_argument("--without", default="", help="sets to leave out, comma between")
    parser.add_argument("--train-store", type=Path, help="instead of RUN/train")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    stores = [options.train_store or options.run / "train", *options.stores]
    stream = ChipStream(stores, options.seed, [name for name in options.without.split(",") if name])
    schedule = Schedule(options.steps, options.rate, warm_up=100, held=options.held)
    recipe = Recipe(schedule, _BATCH, average=0.998, bfloat16=True, checkpoint_every=200, log_every=100)
    begun = CarVerifierNet()
    if options.detector or options.weights:
        chips = torch.stack([stream[k].chip for k in range(256)]).float().div(255.0)
        if options.weights:
            load_exported(begun, options.weights, chips)
        else:
            begin_with_detector(begun, options.detector, chips)
    network = train(begun, stream, losses, recipe, options.run)
    export(cast("CarVerifierNet", network), options.run / "car-verifier.onnx")
    print(f"wrote {options.run / 'car-verifier.onnx'}", flush=True)


if __name__ == "__main__":
    main()
