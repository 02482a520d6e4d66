"""Measure how the chip network separates cars from others, beside detector and verifier.

``python -m research.training.chips.cars CHIPS.onnx R``. ``R`` has the stores ``held_out``
(``mine.py``) and ``people`` (``people.py``). Logistic regression joins the logits. It is fitted on
one half of the held-out files for the other half, and on all of them for ``people``. ``--write``
writes the weights of the search and the chip network into the file, fitted on both stores in equal
parts. Their effect on a set of ``people`` is measured with weights fitted without that set.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from research.training.chips.export import write_weights
from research.training.chips.store import STORED_LENGTH_PX, Rows, read_store
from research.training.chips.stream import cut
from research.training.logistic import area, logistic, weight_of_sets
from vehanchor.detection.chips import ChipNetwork
from vehanchor.models.runtime import Runtime

Flags: TypeAlias = NDArray[np.bool_]
"""Which of the candidates ``[n]`` have a property."""

LogOdds: TypeAlias = NDArray[np.float64]
"""Log odds ``[n]`` of a car."""

# Least score of the detector.
_MIN_SCORE = 0.15
_SHIPPED = ("search", "chips")
_JOINED = {
    "detector": ("detector",),
    "search (detector and verifier)": ("search",),
    "detector and chips, one view": ("detector", "chips, one view"),
    "detector and chips": ("detector", "chips"),
    "search and chips, one view": ("search", "chips, one view"),
    "search and chips": ("search", "chips"),
    "chips": ("chips",),
}


class Judged(NamedTuple):
    """Candidates, whether they are cars, and the logits of each network."""

    rows: Rows
    car: Flags
    logits: dict[str, LogOdds]

    def take(self, which: Flags) -> Judged:
        """Select candidates by a mask."""
        logits = {name: of_network[which] for name, of_network in self.logits.items()}
        return Judged(self.rows.take(which), self.car[which], logits)


def _logit(scores: NDArray[np.float32]) -> NDArray[np.float64]:
    inside = np.clip(scores.astype(np.float64), 1e-4, 1 - 1e-4)
    return np.asarray(np.log(inside / (1 - inside)))


def judged(folder: Path, network: ChipNetwork) -> Judged:
    """Run the networks on the candidates of a store that the search found."""
    chips, rows = read_store(folder)
    indices = np.flatnonzero(rows.score >= _MIN_SCORE)
    rows = rows.take(indices)
    cuts = np.stack([cut(np.asarray(chips[k]), STORED_LENGTH_PX) for k in indices])
    return Judged(
        rows,
        rows.car == 1,
        {
            "detector": _logit(rows.score),
            "search": _logit(rows.combined),
            "chips": network.answers(cuts).logit,
            "chips, one view": network.answers(cuts, views=1).logit,
        },
    )


def _design(cases: Judged, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Build the columns of the regression: logits, and ones for the bias."""
    logits = [cases.logits[name] for name in names]
    ones = np.ones(len(cases.car))
    return np.column_stack([*logits, ones])


def fitted(names: tuple[str, ...], *parts: Judged) -> NDArray[np.float64]:
    """Fit the weights of the logits and a bias.

    Parts have equal weights. In a part, a set has a weight by the root of its number.
    """
    designs = np.concatenate([_design(part, names) for part in parts])
    weights = np.concatenate([weight_of_sets(part.rows.sets) for part in parts])
    return logistic(designs, np.concatenate([part.car for part in parts]), weights)


def joined(train: Judged, test: Judged, names: tuple[str, ...]) -> LogOdds:
    """Compute the log odds of a car for ``test``, from weights fitted on ``train``.

    If both are the same, each half of the files has the weights of the other half.
    """
    design = _design(test, names)
    if train is not test:
        return np.asarray(design @ fitted(names, train))
    half = np.array([zlib.crc32(file.encode()) % 2 for file in train.rows.files])
    odds_of_first = design @ fitted(names, train.take(half != 0))
    odds_of_second = design @ fitted(names, train.take(half != 1))
    return np.where(half == 0, odds_of_first, odds_of_second)


def left_out(train: Judged, test: Judged, names: tuple[str, ...]) -> LogOdds:
    """Compute the log odds of a car for ``test``, each set with weights fitted without it."""
    odds = np.zeros(len(test.car))
    for name in np.unique(test.rows.sets):
        here = test.rows.sets == name
        weights = fitted(names, train, test.take(~here))
        odds[here] = _design(test.take(here), names) @ weights
    return odds


def line(odds: LogOdds, car: Flags) -> str:
    """Format area under the ROC curve, average precision, and precision at two recalls."""
    order = np.argsort(-odds, kind="stable")
    precision = np.cumsum(car[order]) / np.arange(1, len(car) + 1)
    # Precision at each recall: the best at this or a higher one.
    envelope = np.maximum.accumulate(precision[::-1])[::-1][car[order]]
    at_90, at_95 = [envelope[int(recall * len(envelope))] for recall in (0.9, 0.95)]
    areas = f"AUC {area(odds[car], odds[~car]):.4f}, AP {envelope.mean():.4f}"
    return f"{areas}, precision at recall 0.90 and 0.95: {at_90:.3f}, {at_95:.3f}"


def report(train: Judged, test: Judged) -> Iterator[str]:
    """Compare the networks on all candidates and by set."""
    for title, names in _JOINED.items():
        odds = joined(train, test, names)
        yield f"{title}: {line(odds, test.car)}"
        by_set = []
        for name in np.unique(test.rows.sets):
            here = test.rows.sets == name
            cars = here & test.car
            if cars.sum() > 5:
                by_set.append(f"{name} {area(odds[cars], odds[here & ~test.car]):.4f}")
        yield f"    AUC by set: {', '.join(by_set)}"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    network = ChipNetwork(options.network, runtime=Runtime(threads=1))
    held_out = judged(options.folder / "held_out", network)
    print(f"held out: {held_out.car.sum()} cars, {(~held_out.car).sum()} others")
    print("\n".join(report(held_out, held_out)), flush=True)
    people = judged(options.folder / "people", network)
    print(f"people: {people.car.sum()} cars, {(~people.car).sum()} others")
    print("\n".join(report(held_out, people)), flush=True)
    odds = left_out(held_out, people, _SHIPPED)
    print(f"{' and '.join(_SHIPPED)}, each set left out: {line(odds, people.car)}")
    if options.write:
        search, chips, bias = fitted(_SHIPPED, held_out, people)
        write_weights(options.network, (float(search), float(chips), float(bias)))


if __name__ == "__main__":
    main()
