"""Car or not beside detector and verifier: ``python -m research.training.chips.cars CHIPS.onnx R``.

``R`` has the stores ``held_out`` (``mine.py``) and ``people`` (``people.py``). Logits are
joined by logistic regression, fitted on one half of the held-out files for the other, and on all
for ``people``. ``--write`` writes the weights of the search and the chip network into the file,
fitted on both stores in equal parts; what these do for a set of ``people`` is measured with weights
that the set did not choose.
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from research.training.chips.export import write_weights
from research.training.chips.store import STORED_LENGTH_PX, Rows, read_store
from research.training.chips.stream import cut
from research.training.logistic import area, logistic, weight_of_sets
from vehanchor.detection.chips import ChipNetwork
from vehanchor.models.runtime import Runtime

_LEAST_SCORE = 0.15  # of the detector
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
    """Candidates, whether they are cars, and what each network says."""

    rows: Rows
    car: NDArray[np.bool_]
    logits: dict[str, NDArray[np.float64]]

    def take(self, which: NDArray[np.bool_]) -> Judged:
        """Select candidates by a mask."""
        return Judged(
            self.rows.take(which),
            self.car[which],
            {k: each[which] for k, each in self.logits.items()},
        )


def _logit(scores: NDArray[np.float32]) -> NDArray[np.float64]:
    inside = np.clip(scores.astype(np.float64), 1e-4, 1 - 1e-4)
    return np.asarray(np.log(inside / (1 - inside)))


def judged(folder: Path, network: ChipNetwork) -> Judged:
    """Ask the networks about the candidates of a store that the search found."""
    chips, rows = read_store(folder)
    chosen = np.flatnonzero(rows.score >= _LEAST_SCORE)
    rows = rows.take(chosen)
    cuts = np.stack([cut(np.asarray(chips[k]), STORED_LENGTH_PX) for k in chosen])
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
    return np.column_stack([*(cases.logits[name] for name in names), np.ones(len(cases.car))])


def fitted(names: tuple[str, ...], *parts: Judged) -> NDArray[np.float64]:
    """Weights of the logits and a bias; parts count alike, and in a part each set by the root of its number."""
    designs = np.concatenate([_design(part, names) for part in parts])
    weights = np.concatenate([weight_of_sets(part.rows.sets) for part in parts])
    return logistic(designs, np.concatenate([part.car for part in parts]), weights)


def joined(known: Judged, asked: Judged, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Log odds of a car for ``asked``, from weights fitted on ``known``, or on its other half."""
    design = _design(asked, names)
    if known is not asked:
        return np.asarray(design @ fitted(names, known))
    half = np.array([zlib.crc32(file.encode()) % 2 for file in known.rows.files])
    sides = [design @ fitted(names, known.take(half != side)) for side in (0, 1)]
    return np.where(half == 0, *sides)


def left_out(known: Judged, asked: Judged, names: tuple[str, ...]) -> NDArray[np.float64]:
    """Log odds of a car for ``asked``, each set by weights that ``known`` and the other sets chose."""
    odds = np.zeros(len(asked.car))
    for name in np.unique(asked.rows.sets):
        here = asked.rows.sets == name
        odds[here] = _design(asked.take(here), names) @ fitted(names, known, asked.take(~here))
    return odds


def line(odds: NDArray[np.float64], car: NDArray[np.bool_]) -> str:
    """Area under the ROC curve, average precision, and precision at two recalls."""
    order = np.argsort(-odds, kind="stable")
    precision = np.cumsum(car[order]) / np.arange(1, len(car) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1][car[order]]
    at = [envelope[int(recall * len(envelope))] for recall in (0.9, 0.95)]
    both = f"AUC {area(odds[car], odds[~car]):.4f}, AP {envelope.mean():.4f}"
    return f"{both}, precision at recall 0.90 and 0.95: {at[0]:.3f}, {at[1]:.3f}"


def report(known: Judged, asked: Judged) -> Iterator[str]:
    """Compare the networks on all candidates and by set."""
    sets = [str(name) for name in np.unique(asked.rows.sets)]
    for what, names in _JOINED.items():
        odds = joined(known, asked, names)
        yield f"{what}: {line(odds, asked.car)}"
        parts = [(name, asked.rows.sets == name) for name in sets]
        each = [
            f"{n} {area(odds[m & asked.car], odds[m & ~asked.car]):.4f}"
            for n, m in parts
            if (m & asked.car).sum() > 5
        ]
        yield f"    AUC by set: {', '.join(each)}"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    network = ChipNetwork(options.network, runtime=Runtime(threads=1))
    known = judged(options.folder / "held_out", network)
    print(f"held out: {known.car.sum()} cars, {(~known.car).sum()} others")
    print("\n".join(report(known, known)), flush=True)
    people = judged(options.folder / "people", network)
    print(f"people: {people.car.sum()} cars, {(~people.car).sum()} others")
    print("\n".join(report(known, people)), flush=True)
    print(
        f"{' and '.join(_SHIPPED)}, each set left out: "
        f"{line(left_out(known, people, _SHIPPED), people.car)}"
    )
    if options.write:
        search, chips, bias = fitted(_SHIPPED, known, people)
        write_weights(options.network, (float(search), float(chips), float(bias)))


if __name__ == "__main__":
    main()
