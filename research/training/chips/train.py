"""Train the chip network: ``python -m research.training.chips.train RUN --stores ... --readings READ.npz --steps N``.

Resumes from ``RUN/checkpoint.pt`` if that exists; at the end it writes ``RUN/chips.onnx``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import (
    binary_cross_entropy_with_logits,
    cross_entropy,
    log_softmax,
    smooth_l1_loss,
)

from research.training.chips.export import export
from research.training.chips.kinds import CARS, GROUP_OF_KIND, GROUPS
from research.training.chips.network import Answers, ChipNet
from research.training.chips.readings import load
from research.training.chips.stream import NOT_A_CAR, Batch, Bodies, ChipStream
from research.training.loop import Recipe, Schedule, load_average, train
from research.training.warm_start import load_exported
from vehanchor.models.zoo import auxiliary_model, resolve_model

_RATE = 1.2e-3
_BATCH = 64
_SMOOTHING = 0.02  # labels are wrong now and then
_KIND_WEIGHT = 0.4
_EDGE_WEIGHT = 0.6
_SIZE_WEIGHT = 0.6
_SPREAD_WEIGHT = 0.05
_METRES_WEIGHT = 0.25
# errors of this size count one
_EDGE_SCALE = 0.03
_SIZE_SCALE = 0.06
_TURN_SCALE = 0.05
_METRES_SCALE = 0.06


def losses(network: nn.Module, batch: Batch, device: torch.device) -> Mapping[str, Tensor]:
    """Losses of all answers, each where it is known."""
    truth = Batch(*(part.to(device) for part in batch))
    said = Answers(*(part.float() for part in network(truth.chip.float().div(255.0))))
    known = truth.car.isfinite()
    wanted = truth.car.nan_to_num() * (1 - 2 * _SMOOTHING) + _SMOOTHING
    car = binary_cross_entropy_with_logits(said.logit, wanted, reduction="none")
    return {
        "car": _mean(car, known.float()),
        "kind": _KIND_WEIGHT * _kind_loss(said.kinds, truth),
        **_edge_losses(said, truth),
        **_metres_losses(said, truth),
    }


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1.0)


def _kind_loss(logits: Tensor, truth: Batch) -> Tensor:
    """Cross-entropies of kind and group, in equal parts; of no car the chance of all kinds that are none."""
    logs = log_softmax(logits, dim=1)
    groups = torch.from_numpy(GROUP_OF_KIND).to(logits.device)
    grouped = torch.stack(
        [logs[:, groups == k].logsumexp(dim=1) for k in range(len(GROUPS))], dim=1
    )
    some = truth.kind.clamp(min=0)
    each = (
        0.5 * cross_entropy(logits, some, reduction="none")
        - 0.5 * grouped.gather(1, groups[some][:, None])[:, 0]
    )
    none = -logs[:, len(CARS) :].logsumexp(dim=1)
    loss = torch.where(truth.kind == NOT_A_CAR, none, each)
    return _mean(loss, truth.kind_weight * (truth.kind != -1))


def _edge_losses(said: Answers, truth: Batch) -> dict[str, Tensor]:
    """Smooth L1 of edges, turn, length and width; the spreads follow what is left, and do not pull the edges."""
    known = truth.edges.isfinite()
    weight = truth.edge_weight[:, None] * known
    wanted = truth.edges.nan_to_num()
    edge = smooth_l1_loss(
        said.edges / _EDGE_SCALE, wanted / _EDGE_SCALE, reduction="none", beta=1.0
    )
    turn = smooth_l1_loss(
        said.turn / _TURN_SCALE, truth.turn / _TURN_SCALE, reduction="none", beta=1.0
    )
    sizes = []
    for first in (0, 2):
        both = (known[:, first] & known[:, first + 1]).float() * truth.edge_weight
        ours, theirs = (
            torch.where(both > 0, each[:, first + 1] - each[:, first], torch.ones_like(both))
            .clamp(min=0.05)
            .log()
            for each in (said.edges, wanted)
        )
        sizes.append(
            _mean(smooth_l1_loss(ours / _SIZE_SCALE, theirs / _SIZE_SCALE, reduction="none"), both)
        )
    return {
        "edges": _EDGE_WEIGHT * _mean(edge, weight),
        "turn": 0.3 * _mean(turn, truth.edge_weight * known.any(dim=1)),
        "length": _SIZE_WEIGHT * sizes[0],
        "width": _SIZE_WEIGHT * sizes[1],
        "spread": _SPREAD_WEIGHT * _mean(_spread(said.edges, said.edge_log_sd, wanted), weight),
    }


def _metres_losses(said: Answers, truth: Batch) -> dict[str, Tensor]:
    wanted = truth.log_metres.nan_to_num()
    error = smooth_l1_loss(
        said.log_metres / _METRES_SCALE, wanted / _METRES_SCALE, reduction="none"
    )
    spread = _spread(said.log_metres, said.metres_log_sd, wanted)
    return {
        "metres": _METRES_WEIGHT * _mean(error, truth.metres_weight),
        "metres_spread": _SPREAD_WEIGHT * _mean(spread, truth.metres_weight),
    }


def _spread(said: Tensor, log_sd: Tensor, wanted: Tensor) -> Tensor:
    """Negative log likelihood of the error as it stands."""
    return 0.5 * ((said - wanted).detach() * (-log_sd).exp()).square() + log_sd


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--stores", type=Path, nargs="+", required=True)
    parser.add_argument("--readings", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument(
        "--held", type=float, default=0.3, help="share of the steps before the rate falls"
    )
    parser.add_argument("--rate", type=float, default=_RATE)
    parser.add_argument(
        "--without", default="", help="places whose readings are left out, comma between"
    )
    parser.add_argument(
        "--begin", type=Path, help="run whose weights are the first ones; else the bundled file's"
    )
    parser.add_argument(
        "--fresh", action="store_true", help="begin from noise, as --without should"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    read = load(options.readings)
    bodies = Bodies.load(options.readings.with_suffix(".bodies.npz"), len(read.kind))
    learned = ~read.check & ~np.isin(read.place, options.without.split(","))
    bodies = Bodies(*(each[learned] for each in bodies))
    stream = ChipStream(options.stores, read.take(learned), bodies, options.seed)
    network = ChipNet()
    bundled = auxiliary_model(resolve_model(), "chips")
    if options.begin:
        load_average(network, options.begin)
    elif bundled and not options.fresh:
        load_exported(
            network, bundled, torch.stack([stream[k].chip for k in range(256)]).float().div(255.0)
        )
    schedule = Schedule(options.steps, options.rate, warm_up=100, held=options.held)
    recipe = Recipe(
        schedule, _BATCH, average=0.995, bfloat16=True, checkpoint_every=100, log_every=50
    )
    trained = train(network, stream, losses, recipe, options.run)
    export(cast("ChipNet", trained), options.run / "chips.onnx")
    print(f"wrote {options.run / 'chips.onnx'}", flush=True)


if __name__ == "__main__":
    main()
