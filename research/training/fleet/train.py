"""Train the networks that estimate the length of a fleet.

``python -m research.training.fleet.train``; an hour and more on two CPU cores.

Each file is the mean of two networks that had different lessons: one learns how many metres a box is, so that it sees
when a box is too long; one learns how long a fleet's vehicles are together. ``RUN/fleet.onnx`` is the one to ship. The
others are for ``calibrate.py``, which wants opinions from networks that have not seen what they judge: ``fold-0.onnx``
and ``fold-1.onnx`` learn from half of the images each, and ``without-SET.onnx`` from all sets but one: what they say of
it, a new place gets. ``--beside 0.8`` is a control: it looks at the ground beside the vehicles, and tells what cameras
and places alone give away.
"""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from research.training.detector.data import is_dev
from research.training.fleet.data import (
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
from research.training.fleet.network import FleetNet, Mean
from research.training.loop import Recipe, Schedule, train
from research.training.onnx_file import write_onnx
from vehanchor.detection.appearance import CHIP_SHAPE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_RATE = 2e-3
_WARM_UP_STEPS = 400
_BETA = 0.05  # of a log length: beyond it an error counts linearly, for some labels are wrong
_REPORT_LENGTHS_PX = (12.0, 16.0, 24.0, 40.0)
_LEAST_VEHICLES = 3  # of an image in the report


class Lesson(NamedTuple):
    """Training targets of length.

    Attributes:
        name: of the folder of its checkpoint.
        together: vehicles of an image that are drawn at once.
        batch: images a step.
        steps: of the training.
        of_box: whether a length is that of the box, which may be too long, or that of the vehicle.
        length_weight: of a vehicle's own length; this and the next bring all losses to like sizes.
        fleet_weight: of the mean length of those drawn, against that of the whole image: what the tool asks for.
    """

    name: str
    together: int
    batch: int
    steps: int
    of_box: bool
    length_weight: float
    fleet_weight: float


LESSONS = (
    Lesson("box", together=1, batch=64, steps=2500, of_box=True, length_weight=8.0, fleet_weight=0.0),
    Lesson("fleet", together=8, batch=10, steps=1500, of_box=False, length_weight=2.0, fleet_weight=16.0),
)


class ChipStream:
    """Endless stream of images with some chips each: half North America, half the other sets, equally.

    The k-th is the same whenever it is asked for.
    """

    def __init__(self, vehicles: list[Vehicle], lesson: Lesson, seed: int) -> None:
        by_set: dict[str, dict[str, list[Vehicle]]] = {}
        for vehicle in vehicles:
            by_set.setdefault(vehicle.set, {}).setdefault(vehicle.file, []).append(vehicle)
        self.images = {name: list(files.values()) for name, files in by_set.items()}
        sizes = {name: np.array([len(each) for each in images]) for name, images in self.images.items()}
        self.share = {name: size / size.sum() for name, size in sizes.items()}  # an image counts by its vehicles
        self.lesson = lesson
        self.seed = seed

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Chips of one image and their targets.

        NaN where nobody knows: a rendered car is of no region, and not all scales are known.

        Returns:
            ``[n, 1, 16, 24]``; whether they are of North America, ``[n]``; the logs of their lengths in metres,
            ``[n]``; and the mean that these would have if all the image's vehicles had been drawn.
        """
        rng = np.random.default_rng((self.seed, index))
        others = [name for name in self.images if name != NORTH_AMERICA]
        american = rng.random() < 0.5 and NORTH_AMERICA in self.images
        name = NORTH_AMERICA if american else others[rng.integers(len(others))]
        image = self.images[name][rng.choice(len(self.images[name]), p=self.share[name])]
        chosen = [image[k] for k in rng.integers(len(image), size=self.lesson.together)]
        cuts, longer = zip(*(random_chip(vehicle, rng) for vehicle in chosen), strict=True)
        too_long = np.log(longer) if self.lesson.of_box else np.zeros(len(chosen))
        of_america = math.nan if name == SCENES else float(american)
        return (
            torch.from_numpy(np.stack(cuts))[:, None],
            torch.full((len(chosen),), of_america),
            torch.tensor(too_long + [_log_length(vehicle) for vehicle in chosen], dtype=torch.float32),
            torch.tensor(too_long.mean() + np.mean([_log_length(vehicle) for vehicle in image]), dtype=torch.float32),
        )


def _log_length(vehicle: Vehicle) -> float:
    return math.nan if vehicle.length_m is None else math.log(vehicle.length_m)


def losses(lesson: Lesson, network: nn.Module, batch: tuple[Tensor, ...], device: torch.device) -> Mapping[str, Tensor]:
    """Cross-entropy of the log odds, smooth L1 of the log lengths and of their means, all where they are known.

    Each vehicle's own length alone draws every fleet to the middle of all: a single car hardly tells whose it is, and a
    mean of answers that hedge is a hedge.
    """
    chips, american, lengths, fleets = (part.to(device) for part in batch)
    odds, seen = (each.reshape(american.shape) for each in network(chips.flatten(0, 1)))
    known, measured, placed = lengths.isfinite(), fleets.isfinite(), american.isfinite()
    wrong = smooth_l1_loss(seen[known], lengths[known], beta=_BETA) if known.any() else seen.sum() * 0
    means = seen[measured].mean(dim=1)
    fleet = smooth_l1_loss(means, fleets[measured], beta=_BETA) if measured.any() else seen.sum() * 0
    entropy = binary_cross_entropy_with_logits(odds[placed], american[placed]) if placed.any() else odds.sum() * 0
    return {"entropy": entropy, "length": lesson.length_weight * wrong, "fleet": lesson.fleet_weight * fleet}


def trained(
    vehicles: list[Vehicle], lesson: Lesson, seed: int, run: Path | None = None, steps: int | None = None
) -> FleetNet:
    """Train a network on these vehicles, or resume from ``run``; return it in evaluation mode."""
    torch.manual_seed(seed)
    steps = steps or lesson.steps
    schedule = Schedule(steps, _RATE, warm_up=min(_WARM_UP_STEPS, steps // 4 + 1), last=0.0)
    recipe = Recipe(schedule, lesson.batch, average=0.0, checkpoint_every=500, log_every=500)
    stream = ChipStream(vehicles, lesson, seed)
    return cast("FleetNet", train(FleetNet(), stream, partial(losses, lesson), recipe, run))


def export(networks: Sequence[FleetNet], out: Path) -> None:
    """Write the mean of some networks as ONNX: ``chips`` to ``log_odds`` and ``log_length`` ``[n]``."""
    write_onnx(
        Mean(networks),
        (torch.zeros(2, 1, *CHIP_SHAPE),),
        out,
        ["chips"],
        ["log_odds", "log_length"],
        {"chips": {0: "n"}, "log_odds": {0: "n"}, "log_length": {0: "n"}},
    )


def report(networks: Sequence[FleetNet], vehicles: list[Vehicle]) -> list[str]:
    """The images' mean log odds for each set and resolution.

    Their number, mean, spread, share above 0, and area under the ROC curve of North America's images against them.
    """
    lines = ["set, length px: images, mean, sd, share > 0, AUC"]
    american, mean = np.zeros(0), Mean(networks)
    for name in sorted({vehicle.set for vehicle in vehicles}, key=lambda name: (name != NORTH_AMERICA, name)):
        for length in _REPORT_LENGTHS_PX:
            odds: dict[str, list[float]] = {}
            for vehicle in vehicles:
                if vehicle.set == name and vehicle.box[2] > 0.85 * length:
                    cut = torch.from_numpy(vehicle_at_length(vehicle, length))[None, None]
                    with torch.no_grad():
                        odds.setdefault(vehicle.file, []).append(float(mean(cut)[0]))
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
    parser.add_argument(
        "--scenes", type=Path, help="folder of rendered scenes (research.training.detector.render_scenes)"
    )
    parser.add_argument("--steps", type=int, help="of every lesson; without it each has its own")
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
        networks = [
            trained(known, lesson, options.seed, options.run / name / lesson.name, options.steps) for lesson in LESSONS
        ]
        export(networks, options.run / f"{name}.onnx")
        if unseen:
            others = [vehicle for vehicle in unseen if vehicle.set != NORTH_AMERICA]
            print("\n".join(report(networks, american + others)), flush=True)


if __name__ == "__main__":
    main()
