"""Read some cars a second time: ``python -m research.training.readings.again FOLDER``.

Draws 36 cars of the sheets of ends and 48 of the sheets of kinds again, flipped and rescaled, in another order. With
``--compare`` it prints how the second readings (``readings/again_*.txt``) differ from the first.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from research.training.readings.candidates import read_candidates
from research.training.readings.sheets import (
    candidate_of,
    chips_of,
    end_view,
    kind_view,
    median_lengths,
    read_chips,
    write_sheets,
)
from research.training.readings.table import (
    Reading,
    difference,
    in_image,
    parse_ends,
    parse_kinds,
    read_ends,
    read_kinds,
)
from research.training.readings.views import ENDS, KINDS

_ENDS, _KINDS = 36, 48
_END_FACTOR, _KIND_FACTOR = 0.9, 1.2
_GROUPS = {
    "kei": "small", "small": "small", "compact": "car", "saloon": "car", "suv": "car", "pickup": "pickup", "van": "van",
}  # fmt: skip


def group_of_kind(kind: str) -> str:
    """Return one of small, car, pickup, van; other things are ``other``."""
    return _GROUPS.get(kind, "other")


def draw(folder: Path, data: Path) -> None:
    """Draw both sets of sheets."""
    rng = np.random.default_rng(1)
    complete = [reading for reading in read_ends(folder) if None not in reading.edges]
    chosen = [candidate_of(complete[k].chip) for k in rng.choice(len(complete), _ENDS, replace=False)]
    views = [end_view(car, rng, flip=-1, factor=_END_FACTOR) for car in chosen]
    write_sheets(chips_of("again_ends", chosen, views, ENDS), ENDS, folder, data, "again_ends")
    groups = sorted(set(_GROUPS.values()))
    by_group = {group: [chip for chip, kind in read_kinds(folder) if group_of_kind(kind) == group] for group in groups}
    cars = [
        candidate_of(chips[k])
        for chips in by_group.values()
        for k in rng.choice(len(chips), min(len(chips), _KINDS // len(groups)), replace=False)
    ]
    cars = [cars[k] for k in rng.permutation(len(cars))]
    medians = median_lengths(read_candidates(folder / "candidates.csv"))
    kind_views = [kind_view(car, medians[car.file], rng, flip=-1, factor=_KIND_FACTOR) for car in cars]
    write_sheets(chips_of("again_kinds", cars, kind_views, KINDS), KINDS, folder, data, "again_kinds")


def _sizes(reading: Reading) -> tuple[float, float] | None:
    offsets = in_image(reading)
    length, width = difference(offsets[:2]), difference(offsets[2:])
    return None if length is None or width is None else (length, width)


def compare(folder: Path) -> None:
    """Print the differences of logs of length and width, and the agreement of kinds."""
    notes = folder / "readings"
    first = {reading.chip.box: reading for reading in read_ends(folder)}
    second = list(parse_ends(notes / "again_ends.txt", read_chips(folder / "again_ends.csv")))
    pairs = [(_sizes(first[reading.chip.box]), _sizes(reading)) for reading in second]
    logs = np.asarray([np.log(np.divide(two, one)) for one, two in pairs if one and two])
    for name, values in zip(("length", "width"), logs.T, strict=True):
        print(f"{name}: n {len(values)}, mean {values.mean():+.4f}, sd {values.std(ddof=1):.4f}")
    kinds = {(chip.file, chip.box): kind for chip, kind in read_kinds(folder)}
    both = [
        (kinds[chip.file, chip.box], kind)
        for chip, kind in parse_kinds(notes / "again_kinds.txt", read_chips(folder / "again_kinds.csv"))
    ]
    same = np.mean([one == two for one, two in both])
    grouped = np.mean([group_of_kind(one) == group_of_kind(two) for one, two in both])
    print(f"kinds: n {len(both)}, same {same:.2f}, same group {grouped:.2f}")
    print("different:", *(f"{one}>{two}" for one, two in both if one != two))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--compare", action="store_true")
    options = parser.parse_args()
    if options.compare:
        compare(options.folder)
    else:
        draw(options.folder, options.data)


if __name__ == "__main__":
    main()
