"""Measure labelled cars of known scale for the chip network.

``python -m research.training.chips.bodies CHIPS.onnx READ.npz STORE ...``.

A box gives no body. The edges of a first chip network, times the scale, give thousands of bodies
from which a second one learns metres by looks. Writes ``bodies.npz`` into each store, and
``READ.bodies.npz``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.training.chips.kinds import CARS
from research.training.chips.readings import READ_LENGTH_PX, load
from research.training.chips.store import STORED_LENGTH_PX, read_store
from research.training.chips.stream import Bodies, cut
from vehanchor.detection.chips import ChipAnswers, ChipNetwork
from vehanchor.models.runtime import Runtime
from vehanchor.storage.atomic import whole_file

# Spread of a log length at which a body has half of its weight.
_OWN_SD = 0.06
_RENDERED = ("scene", "pasted")


def measured(answers: ChipAnswers, candidate_m: NDArray[np.float64]) -> Bodies:
    """Measure the bodies of candidates whose lengths in metres are known."""
    logs = np.log(answers.sizes * candidate_m[:, None])
    # The variance of a body over that of a measurement by its own.
    variances = 1 + (answers.log_size_sd / _OWN_SD) ** 2
    weight = 1 / variances
    return Bodies(logs.astype(np.float32), weight.astype(np.float32))


def save(bodies: Bodies, path: Path) -> None:
    """Write bodies."""
    with whole_file(path) as partial, partial.open("wb") as handle:
        np.savez(handle, log_metres=bodies.log_metres, weight=bodies.weight)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("readings", type=Path)
    parser.add_argument("stores", type=Path, nargs="+")
    options = parser.parse_args()
    network = ChipNetwork(options.network, runtime=Runtime(threads=1))
    read = load(options.readings)
    answers = network.answers(np.stack([cut(chip, READ_LENGTH_PX) for chip in read.chips]))
    bodies = measured(answers, read.length_px * read.gsd)
    save(bodies, options.readings.with_suffix(".bodies.npz"))
    for place in np.unique(read.place):
        for k, kind in enumerate(CARS):
            is_known = np.isfinite(bodies.log_metres[:, 0])
            here = (read.place == place) & (read.kind == k) & is_known
            if here.sum() > 4:
                sizes = np.exp(np.median(bodies.log_metres[here], axis=0))
                print(
                    f"{place} {kind}: {here.sum()} cars, {sizes[0]:.2f} by {sizes[1]:.2f} m",
                    flush=True,
                )
    for folder in options.stores:
        chips, rows = read_store(folder)
        has_length = np.isfinite(rows.log_length_m) & np.isfinite(rows.box[:, 2])
        is_known = has_length & (rows.car == 1)
        indices = np.flatnonzero(is_known & ~np.isin(rows.sets, _RENDERED))
        logs = np.full((len(is_known), 2), np.nan, np.float32)
        weight = np.zeros((len(is_known), 2), np.float32)
        for start in range(0, len(indices), 512):
            batch = indices[start : start + 512]
            cuts = [cut(np.asarray(chips[k]), STORED_LENGTH_PX) for k in batch]
            answers = network.answers(np.stack(cuts), views=2)
            log_candidate_m = rows.log_length_m[batch] - rows.box[batch, 2]
            candidate_m = np.exp(log_candidate_m.astype(np.float64))
            logs[batch], weight[batch] = measured(answers, candidate_m)
        save(Bodies(logs, weight), folder / "bodies.npz")
        for name in np.unique(rows.sets[indices]):
            here = indices[rows.sets[indices] == name]
            boxes = np.exp(np.median(rows.log_length_m[here]))
            sizes = np.exp(np.median(logs[here], axis=0))
            bodies_text = f"bodies {sizes[0]:.2f} by {sizes[1]:.2f} m"
            print(
                f"{folder.name} {name}: {len(here)} cars, boxes {boxes:.2f} m, {bodies_text}",
                flush=True,
            )


if __name__ == "__main__":
    main()
