"""Compare a run with the current scores.

``python -m research.training.car_verifier.measure RUN --weights TRAINED --out FILE`` reads ``RUN/val.npz`` of ``cases``
and the checkpoint in ``TRAINED``. It orders candidates by today's score (vehicles alone, and with the scene-scale
prior), by the verifier, and by sums of log odds. For each set it writes average precision, precision at recalls of 0.8
and 0.9, and recall at precisions of 0.95, 0.9 and 0.8.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from research.training.car_verifier.cases import Cases, read_cases
from research.training.car_verifier.mine import LOOKED_AT
from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.store import read_store
from research.training.car_verifier.stream import Move, cut
from research.training.loop import load_average
from vehanchor.detection.car_verifier import CHIP_LENGTH_PX, CHIP_PX
from vehanchor.detection.verifier import surroundings
from vehanchor.storage.atomic import whole_file

VIEWS: tuple[tuple[int, int, float], ...] = ((1, 1, 1.0), (1, -1, 1.0), (-1, 1, 1.0), (-1, -1, 1.0))
_SIZE_WEIGHT = 0.3  # of the scene-scale prior in today's scores, see ``training/verifier``
_SAME_PLACE, _SAME_SIZE = 0.35, 0.35  # of a length; log
_LEAST_COMBINED = 0.1  # of today's scores, as in ``cases``
_FIRST_ADDED = 1_000_000  # number of labels that we added
_RECALLS, _PRECISIONS = (0.8, 0.9), (0.95, 0.9, 0.8)


def mirrored(chips: NDArray[np.uint8], along: int, across: int) -> NDArray[np.uint8]:
    """Chips ``[n, h, w, 3]`` mirrored along or across their axis."""
    return chips[:, :: 1 if across > 0 else -1, :: 1 if along > 0 else -1]


class Verified:
    """Answers of a network for boxes of images, means over views."""

    def __init__(self, network: CarVerifierNet, views: tuple[tuple[int, int, float], ...] = VIEWS) -> None:
        self._network, self._views = network.eval(), views

    @torch.no_grad()
    def answers(self, pixels: NDArray[np.uint8], boxes: NDArray[np.float64]) -> NDArray[np.float64]:
        """``[n, 17]``: logit, chances of types, box correction, log length in metres."""
        total = np.zeros((len(boxes), 17))
        for along, across, size in self._views:
            sized = boxes * (1, 1, size, size, 1)
            chips = mirrored(surroundings(pixels, sized, CHIP_PX, CHIP_LENGTH_PX), along, across)
            for start in range(0, len(boxes), 128):
                batch = np.ascontiguousarray(chips[start : start + 128].transpose(0, 3, 1, 2))
                said = self._network(torch.from_numpy(batch).float().div(255.0))
                box = said.box.numpy() * (along, across, 1, 1, along * across) + (0, 0, np.log(size), np.log(size), 0)
                rows = np.column_stack([said.logit, said.types.softmax(dim=1), box, said.log_length_m])
                total[start : start + 128] += rows
        return total / len(self._views)


def verified(
    cases: Cases, network: CarVerifierNet, views: tuple[tuple[int, int, float], ...] = VIEWS
) -> NDArray[np.float64]:
    """Answers ``[n, 17]`` for all candidates."""
    verifier = Verified(network, views)
    out = np.zeros((len(cases.score), 17))
    for file in np.unique(cases.files):
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        assert image is not None
        chosen = cases.files == file
        out[chosen] = verifier.answers(np.ascontiguousarray(image[:, :, ::-1]), cases.boxes[chosen])
    return out


def curve(order: NDArray[np.float64], keys: NDArray[np.str_], n_labels: int) -> dict[str, float]:
    """Average precision and points of the curve; of several candidates on one label the surest is its hit.

    Args:
        order: ``[n]`` scores.
        keys: ``[n]`` the label each candidate fits, empty for none.
        n_labels: labelled cars.
    """
    best = np.argsort(-order, kind="stable")
    taken: set[str] = set()
    hit = np.zeros(len(best), bool)
    for k, row in enumerate(best):
        if keys[row] and keys[row] not in taken:
            taken.add(str(keys[row]))
            hit[k] = True
    found = hit.cumsum()
    recall, precision = found / max(n_labels, 1), found / np.arange(1, len(best) + 1)
    upper = np.maximum.accumulate(precision[::-1])[::-1]
    out = {"ap": float((upper * hit).sum() / max(n_labels, 1))}
    for wanted in _RECALLS:
        reached = recall >= wanted
        out[f"precision_at_recall_{wanted}"] = float(upper[reached.argmax()]) if reached.any() else 0.0
    for wanted in _PRECISIONS:
        good = precision >= wanted
        out[f"recall_at_precision_{wanted}"] = float(recall[good].max()) if good.any() else 0.0
    return {name: round(value, 4) for name, value in out.items()}


def corrected(cases: Cases, looked_at: Path = LOOKED_AT) -> Cases:
    """Correct cases by contact sheets of the surest false alarms: cars become labels, doubtful ones go."""
    label, kept, added = cases.label.copy(), np.ones(len(cases.label), bool), dict.fromkeys(cases.set_names.tolist(), 0)
    names = np.array([Path(file).name for file in cases.files])
    with looked_at.open(newline="") as handle:
        for number, row in enumerate(csv.DictReader(handle)):
            gap = np.hypot(cases.boxes[:, 0] - float(row["x"]), cases.boxes[:, 1] - float(row["y"]))
            there = (names == row["file"]) & (gap < _SAME_PLACE * float(row["length"])) & (label < 0)
            if row["kind"] == "car" and there.any():
                fits = there & (np.abs(np.log(cases.boxes[:, 2] / float(row["length"]))) < _SAME_SIZE)
                label[fits] = _FIRST_ADDED + number
                added[row["set"]] += 1
            elif row["kind"] == "doubtful":
                kept &= ~there
    total = np.array([count + added[name] for name, count in zip(cases.set_names, cases.n_labels, strict=True)])
    rows = (each[kept] for each in (*cases[:3], label, *cases[4:6]))
    return Cases(*rows, cases.set_names, total)  # type: ignore[arg-type, call-arg]


def logit(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log odds of scores, away from 0 and 1."""
    inside = np.clip(scores, 1e-4, 1 - 1e-4)
    return np.asarray(np.log(inside / (1 - inside)))


class Fusion(NamedTuple):
    """Log odds of a car: ``today * logit(score) + new * logit + bias``."""

    today: float
    new: float
    bias: float


EVEN = Fusion(1.0, 1.0, 0.0)


def fitted_fusion(run: Path, network: CarVerifierNet, without: Sequence[str] = ()) -> Fusion:
    """Fit by logistic regression on the candidates of the held-out tenth, each set by the root of its number.

    Args:
        run: folder of the store ``held_out``.
        network: car verifier.
        without: sets that are left out.
    """
    chips, rows = read_store(run / "held_out")
    sure = (rows.combined >= _LEAST_COMBINED) & ((rows.box_weight > 0) | (rows.car == 0))
    chosen = np.flatnonzero(sure & ~np.isin(rows.sets, list(without)))
    still = Move(np.zeros(2), 1.0, 0.0, np.ones(2))
    new = np.zeros(len(chosen))
    with torch.no_grad():
        for start in range(0, len(chosen), 128):
            some = chosen[start : start + 128]
            batch = np.stack([cut(np.asarray(chips[k]), still) for k in some]).transpose(0, 3, 1, 2)
            said = network.eval()(torch.from_numpy(np.ascontiguousarray(batch)).float().div(255.0))
            new[start : start + 128] = said.logit.numpy()
    design = np.column_stack([logit(rows.combined[chosen].astype(np.float64)), new, np.ones(len(chosen))])
    car = rows.car[chosen] == 1
    names, number, counts = np.unique(rows.sets[chosen], return_inverse=True, return_counts=True)
    weight = (1 / np.sqrt(counts))[number]
    theta = np.array([0.5, 0.5, 0.0])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-design @ theta))
        slope = design.T @ (weight * (chance - car)) + 1e-3 * theta
        bend = (design * (weight * chance * (1 - chance))[:, None]).T @ design + 1e-3 * np.eye(3)
        theta = theta - np.linalg.solve(bend, slope)
    print(f"held-out tenth: {car.sum()} cars, {(~car).sum()} others of {len(names)} sets, fusion {theta.round(3)}")
    return Fusion(*(float(value) for value in theta))


def orders(cases: Cases, answers: NDArray[np.float64], fusion: Fusion = EVEN) -> dict[str, NDArray[np.float64]]:
    """The scores to compare."""
    today, new = logit(cases.score), answers[:, 0]
    prior = _SIZE_WEIGHT * cases.size_odds
    return {
        "today": today,
        "today_with_prior": today + prior,
        "new": new,
        "sum": today + new,
        "new_with_prior": new + prior,
        "sum_with_prior": today + new + prior,
        "fitted": fusion.today * today + fusion.new * new + fusion.bias,
        "fitted_with_prior": fusion.today * today + fusion.new * new + fusion.bias + prior,
    }


def measured(cases: Cases, answers: NDArray[np.float64], fusion: Fusion = EVEN) -> dict[str, dict[str, object]]:
    """Curves by set and by order; false alarms of sets without cars."""
    ways = orders(cases, answers, fusion)
    fits = cases.label >= 0
    names = np.char.add(np.char.add(cases.files, "#"), cases.label.astype(str))
    keys = np.where(fits, names, "")
    out: dict[str, dict[str, object]] = {}
    for name, count in zip(cases.set_names.tolist(), cases.n_labels.tolist(), strict=True):
        chosen = cases.sets == name
        row: dict[str, object] = {"cars": count, "candidates": int(chosen.sum())}
        for way, values in ways.items():
            if count:
                row[way] = curve(values[chosen], keys[chosen], count)
            else:
                row[way] = {"above_even": int((values[chosen] > 0).sum())}
        out[name] = row
    return out


def box_errors(cases: Cases, answers: NDArray[np.float64]) -> dict[str, dict[str, float]]:
    """Spread of the log ratio of corrected and uncorrected lengths over the images' own medians, by set."""
    out = {}
    for name in np.unique(cases.sets[cases.label >= 0]):
        chosen = (cases.sets == name) & (cases.label >= 0)
        out[str(name)] = {"median_log_correction": round(float(np.median(answers[chosen, 13])), 4)}
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--weights", type=Path, required=True, help="folder of a checkpoint")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--sets", default="", help="only these, comma between")
    parser.add_argument("--least", type=float, default=0.0, help="leave out candidates of lower scores")
    parser.add_argument("--single", action="store_true", help="one view instead of four")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    cases = corrected(read_cases(options.run / "val.npz"))
    if options.sets or options.least:
        wanted = options.sets.split(",") if options.sets else cases.set_names.tolist()
        chosen, kept = np.isin(cases.sets, wanted), np.isin(cases.set_names, wanted)
        chosen &= cases.score >= options.least
        rows = (each[chosen] for each in cases[:6])
        cases = Cases(*rows, cases.set_names[kept], cases.n_labels[kept])  # type: ignore[arg-type, call-arg]
    network = CarVerifierNet()
    load_average(network, options.weights)
    fusion = fitted_fusion(options.run, network)
    answers = verified(cases, network, VIEWS[:1] if options.single else VIEWS)
    result = {
        "fusion": fusion._asdict(),
        "curves": measured(cases, answers, fusion),
        "boxes": box_errors(cases, answers),
    }
    for name, row in result["curves"].items():
        print(name, {key: value for key, value in row.items() if not isinstance(value, dict)})
        for way, values in row.items():
            if isinstance(values, dict):
                print(f"  {way:18s} {' '.join(f'{value:.3f}' for value in values.values())}")
    if options.out:
        with whole_file(options.out) as partial:
            partial.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
