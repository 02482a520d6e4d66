"""Train the chip network: ``python -m research.training.chips.train RUN --stores S --readings R``.

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
from research.training.letters.export import HEAD_PREFIX
from research.training.loop import Recipe, Schedule, load_average, train
from research.training.warm_start import load_exported
from vehanchor.models.zoo import auxiliary_model, resolve_model

_RATE = 1.2e-3
_BATCH = 64
# Labels are wrong now and then.
_SMOOTHING = 0.02
_KIND_WEIGHT = 0.4
_EDGE_WEIGHT = 0.6
_SIZE_WEIGHT = 0.6
_SPREAD_WEIGHT = 0.05
_METRES_WEIGHT = 0.25
# Errors of this size have a loss of about one.
_EDGE_SCALE = 0.03
_SIZE_SCALE = 0.06
_TURN_SCALE = 0.05
_METRES_SCALE = 0.06


def losses(network: nn.Module, batch: Batch, device: torch.device) -> Mapping[str, Tensor]:
    """Compute the losses of all answers, each where the truth is known."""
    truth = Batch(*(part.to(device) for part in batch))
    outputs = network(truth.chip.float().div(255.0))
    answers = Answers(*(output.float() for output in outputs))
    is_known = truth.car.isfinite()
    target = truth.car.nan_to_num() * (1 - 2 * _SMOOTHING) + _SMOOTHING
    car = binary_cross_entropy_with_logits(answers.logit, target, reduction="none")
    return {
        "car": _mean(car, is_known.float()),
        "kind": _KIND_WEIGHT * _kind_loss(answers.kinds, truth),
        **_edge_losses(answers, truth),
        **_metres_losses(answers, truth),
    }


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1.0)


def _kind_loss(logits: Tensor, truth: Batch) -> Tensor:
    """Compute the cross-entropies of kind and group, in equal parts.

    For an object that is only known not to be a car, the chance of all other kinds counts.
    """
    logs = log_softmax(logits, dim=1)
    groups = torch.from_numpy(GROUP_OF_KIND).to(logits.device)
    group_logs = [logs[:, groups == k].logsumexp(dim=1) for k in range(len(GROUPS))]
    by_group = torch.stack(group_logs, dim=1)
    # Unknown kinds get any index here, and a weight of 0 below.
    kind = truth.kind.clamp(min=0)
    of_kind = cross_entropy(logits, kind, reduction="none")
    of_group = by_group.gather(1, groups[kind][:, None])[:, 0]
    not_a_car = -logs[:, len(CARS) :].logsumexp(dim=1)
    loss = torch.where(truth.kind == NOT_A_CAR, not_a_car, 0.5 * of_kind - 0.5 * of_group)
    return _mean(loss, truth.kind_weight * (truth.kind != -1))


def _edge_losses(answers: Answers, truth: Batch) -> dict[str, Tensor]:
    """Compute smooth L1 losses of edges, turn, length and width, and the loss of the spreads.

    The spreads follow the remaining errors, and do not pull the edges.
    """
    is_known = truth.edges.isfinite()
    weight = truth.edge_weight[:, None] * is_known
    edges = truth.edges.nan_to_num()
    edge = _smooth_l1(answers.edges, edges, _EDGE_SCALE)
    turn = _smooth_l1(answers.turn, truth.turn, _TURN_SCALE)
    spread = _spread(answers.edges, answers.edge_log_sd, edges)
    # A length or width needs both of its edges, 0 and 1 or 2 and 3.
    sizes = []
    for first in (0, 2):
        both = (is_known[:, first] & is_known[:, first + 1]).float() * truth.edge_weight
        log_size = _log_size(answers.edges, first, both)
        true_log_size = _log_size(edges, first, both)
        sizes.append(_mean(_smooth_l1(log_size, true_log_size, _SIZE_SCALE), both))
    return {
        "edges": _EDGE_WEIGHT * _mean(edge, weight),
        "turn": 0.3 * _mean(turn, truth.edge_weight * is_known.any(dim=1)),
        "length": _SIZE_WEIGHT * sizes[0],
        "width": _SIZE_WEIGHT * sizes[1],
        "spread": _SPREAD_WEIGHT * _mean(spread, weight),
    }


def _log_size(edges: Tensor, first: int, weight: Tensor) -> Tensor:
    """Compute the log of the distance of two edges; 0 where the weight is 0."""
    distance = edges[:, first + 1] - edges[:, first]
    size = torch.where(weight > 0, distance, torch.ones_like(weight))
    return size.clamp(min=0.05).log()


def _smooth_l1(values: Tensor, targets: Tensor, scale: float) -> Tensor:
    return smooth_l1_loss(values / scale, targets / scale, reduction="none", beta=1.0)


def _metres_losses(answers: Answers, truth: Batch) -> dict[str, Tensor]:
    targets = truth.log_metres.nan_to_num()
    error = _smooth_l1(answers.log_metres, targets, _METRES_SCALE)
    spread = _spread(answers.log_metres, answers.metres_log_sd, targets)
    return {
        "metres": _METRES_WEIGHT * _mean(error, truth.metres_weight),
        "metres_spread": _SPREAD_WEIGHT * _mean(spread, truth.metres_weight),
    }


def _spread(values: Tensor, log_sd: Tensor, targets: Tensor) -> Tensor:
    """Compute the negative log likelihood of the errors, whose gradient reaches ``log_sd`` only."""
    return 0.5 * ((values - targets).detach() * (-log_sd).exp()).square() + log_sd


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
        "--without", default="", help="places whose readings are left out, separated by commas"
    )
    parser.add_argument(
        "--begin",
        type=Path,
        help="run whose weights training begins with; default: those of the bundled file",
    )
    parser.add_argument(
        "--fresh", action="store_true", help="begin with random weights, as --without should"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)
    read = load(options.readings)
    bodies = Bodies.load(options.readings.with_suffix(".bodies.npz"), len(read.kind))
    learned = ~read.check & ~np.isin(read.place, options.without.split(","))
    bodies = Bodies(bodies.log_metres[learned], bodies.weight[learned])
    stream = ChipStream(options.stores, read.take(learned), bodies, options.seed)
    network = ChipNet()
    bundled = auxiliary_model(resolve_model(), "chips")
    if options.begin:
        load_average(network, options.begin)
    elif bundled and not options.fresh:
        chips = torch.stack([stream[k].chip for k in range(256)])
        crops = chips.float().div(255.0)
        load_exported(network, bundled, crops, without=(HEAD_PREFIX,))
    schedule = Schedule(options.steps, options.rate, warm_up=100, held=options.held)
    recipe = Recipe(
        schedule, _BATCH, average=0.995, bfloat16=True, checkpoint_every=100, log_every=50
    )
    trained = train(network, stream, losses, recipe, options.run)
    export(cast("ChipNet", trained), options.run / "chips.onnx")
    print(f"wrote {options.run / 'chips.onnx'}", flush=True)


if __name__ == "__main__":
    main()
