"""Train the networks that tell a fleet's length: ``python -m training.fleet.train``; 25 minutes on two CPU cores.

``RUN/fleet.onnx`` is the one to ship. The others are for ``calibrate.py``, which wants opinions from networks that have
not seen what they judge: ``fold-0.onnx`` and ``fold-1.onnx`` learn from half of the images each, and
``without-SET.onnx`` from all sets but one: what they say of it, a new place gets. ``--beside 0.8`` is a control: it
looks at the ground beside the vehicles, and tells what cameras and places alone give away.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from training.detector.data import is_dev
from training.fleet.data import (
    MEASURED,
    N_FOLDS,
    NORTH_AMERICA,
    SCENES,
    Vehicle,
    beside,
    fold_of,
    load_scene_vehicles,
    load_vehicles,
    random_chip,
    vehicle_at_length,
)
from training.fleet.network import FleetNet, Mirrored
from training.loop import Recipe, Schedule, train
from training.onnx_file import write_onnx
from vehanchor.detection.look import CHIP_SHAPE

if TYPE_CHECKING:
    from collections.abc import Mapping

_BATCH = 64
_STEPS = 4000
_RATE = 2e-3
_WARM_UP_STEPS = 400
_BETA = 0.05  # of a log length: beyond it an error counts linearly, for some labels are wrong
_LENGTH_WEIGHT = 8.0  # brings both losses to the same size
_REPORT_LENGTHS_PX = (12.0, 16.0, 24.0, 40.0)
_LEAST_VEHICLES = 3  # of an image in the report


class ChipStream:
    """Chips without end: half of North America, half of the other sets, each of these counting alike.

    The k-th chip is the same whenever it is asked for.
    """

    def __init__(self, vehicles: list[Vehicle], seed: int) -> None:
        self.by_set: dict[str, list[Vehicle]] = {}
        for vehicle in vehicles:
            self.by_set.setdefault(vehicle.set, []).append(vehicle)
        self.seed = seed

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """A chip ``[1, 16, 24]``, whether it is North American, and the log of its length in metres.

        NaN where nobody knows: a rendered car is of no region, and not all scales are known.
        """
        rng = np.random.default_rng((self.seed, index))
        others = [name for name in self.by_set if name != NORTH_AMERICA]
        american = rng.random() < 0.5 and NORTH_AMERICA in self.by_set
        among = self.by_set[NORTH_AMERICA if american else others[rng.integers(len(others))]]
        vehicle = among[rng.integers(len(among))]
        length = math.nan if vehicle.length_m is None else math.log(vehicle.length_m)
        cut = random_chip(vehicle, rng)
        of_america = math.nan if vehicle.set == SCENES else float(american)
        return torch.from_numpy(cut)[None], torch.tensor(of_america), torch.tensor(length)


def losses(network: nn.Module, batch: tuple[Tensor, Tensor, Tensor], device: torch.device) -> Mapping[str, Tensor]:
    """Cross-entropy of the log odds and smooth L1 of the log lengths, both where they are known."""
    chips, american, lengths = (part.to(device) for part in batch)
    odds, seen = network(chips)
    known = lengths.isfinite()
    wrong = smooth_l1_loss(seen[known], lengths[known], beta=_BETA) if known.any() else seen.sum() * 0
    placed = american.isfinite()
    entropy = binary_cross_entropy_with_logits(odds[placed], american[placed]) if placed.any() else odds.sum() * 0
    return {"entropy": entropy, "length": _LENGTH_WEIGHT * wrong}


def trained(vehicles: list[Vehicle], steps: int, seed: int, run: Path | None = None) -> FleetNet:
    """A network that has learned from these vehicles, in evaluation mode; resumed from ``run`` where that is given."""
    torch.manual_seed(seed)
    schedule = Schedule(steps, _RATE, warm_up=min(_WARM_UP_STEPS, steps // 4 + 1), last=0.0)
    recipe = Recipe(schedule, _BATCH, average=0.0, checkpoint_every=500, log_every=500)
    return cast("FleetNet", train(FleetNet(), ChipStream(vehicles, seed), losses, recipe, run))


def export(network: FleetNet, out: Path) -> None:
    """Write a network as ONNX, the mean over mirror images: ``chips`` to ``log_odds`` and ``log_length`` ``[n]``."""
    write_onnx(
        Mirrored(network),
        (torch.zeros(2, 1, *CHIP_SHAPE),),
        out,
        ["chips"],
        ["log_odds", "log_length"],
        {"chips": {0: "n"}, "log_odds": {0: "n"}, "log_length": {0: "n"}},
    )


def report(network: FleetNet, vehicles: list[Vehicle]) -> list[str]:
    """The images' mean log odds for each set and resolution.

    Their number, mean, spread, share above 0, and area under the ROC curve of North America's images against them.
    """
    lines = ["set, length px: images, mean, sd, share > 0, AUC"]
    american = np.zeros(0)
    for name in sorted({vehicle.set for vehicle in vehicles}, key=lambda name: (name != NORTH_AMERICA, name)):
        for length in _REPORT_LENGTHS_PX:
            odds: dict[str, list[float]] = {}
            for vehicle in vehicles:
                if vehicle.set == name and vehicle.box[2] > 0.85 * length:
                    cut = torch.from_numpy(vehicle_at_length(vehicle, length))[None, None]
                    with torch.no_grad():
                        odds.setdefault(vehicle.file, []).append(float(Mirrored(network)(cut)[0]))
            means = np.array([np.mean(each) for each in odds.values() if len(each) >= _LEAST_VEHICLES])
            if len(means):
                american = american if len(american) else means
                spread, share, area = means.std(), np.mean(means > 0), np.mean(american[:, None] > means)
                lines.append(
                    f"{name:9s} {length:4.0f}: {len(means):3d} {means.mean():+.2f} {spread:.2f} {share:.2f} {area:.3f}"
                )
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--run", type=Path, default=Path("runs/fleet"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenes", type=Path, help="folder of rendered scenes (training.detector.render_scenes)")
    parser.add_argument("--steps", type=int, default=_STEPS)
    parser.add_argument("--beside", type=float, default=0.0, metavar="LENGTHS")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.run.mkdir(parents=True, exist_ok=True)
    found = load_vehicles(options.data) + (load_scene_vehicles(options.scenes) if options.scenes else [])
    vehicles = [beside(vehicle, options.beside) for vehicle in found]
    dev = [vehicle for vehicle in vehicles if is_dev(vehicle.file, vehicle.set)]
    learned = [vehicle for vehicle in vehicles if not is_dev(vehicle.file, vehicle.set)]
    parts = {"fleet": (learned, dev)}
    if not options.beside:
        for fold in range(N_FOLDS):
            parts[f"fold-{fold}"] = [v for v in vehicles if fold_of(v.file, v.set) != fold], []
        for name in MEASURED:
            parts[f"without-{name}"] = [v for v in learned if v.set != name], [v for v in vehicles if v.set == name]
    american = [vehicle for vehicle in dev if vehicle.set == NORTH_AMERICA]
    for name, (known, unseen) in parts.items():
        print(f"{name}: {len(known)} vehicles", flush=True)
        network = trained(known, options.steps, options.seed, options.run / name)
        export(network, options.run / f"{name}.onnx")
        if unseen:
            others = [vehicle for vehicle in unseen if vehicle.set != NORTH_AMERICA]
            print("\n".join(report(network, american + others)), flush=True)


if __name__ == "__main__":
    main()
