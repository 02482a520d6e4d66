"""Compare today's answers with the frozen ones: ``python -m research.benchmarks.frozen [--write]``.

``frozen.csv`` has the answer on each example photograph and on 200 photographs of ``shared/data``,
and the run's CPU seconds. The photographs are taken from its folders in turn, in the order of their
paths' SHA-256. A file that is absent is skipped. The exit status is 1 if an answer has changed;
``--write`` freezes today's answers.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import itertools
import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

from vehanchor.engine import Engine
from vehanchor.errors import VehAnchorError
from vehanchor.models.runtime import Runtime

TABLE = Path(__file__).with_suffix(".csv")
ROOT = Path(__file__).parents[2]
_FOLDERS = (
    "chia",
    "fleets",
    "flights",
    "segments/images",
    "tilt",
    "unlabelled",
    "upright",
    "vehicles",
)
# Our choice, which takes some three minutes.
_PHOTOGRAPHS = 200
# Relative tolerance: two units of the table's last digit.
_EQUAL = 2e-3


class Frozen(NamedTuple):
    """An answer: a line of the table."""

    file: str
    status: str
    gsd_m_per_px: str
    low: str
    high: str
    confidence: str


def _order(path: Path) -> bytes:
    return hashlib.sha256(path.as_posix().encode()).digest()


def photographs(data: Path) -> dict[str, Path]:
    """List the examples, and photographs of each folder in turn, by their names in the table."""
    examples = sorted(path.relative_to(ROOT) for path in (ROOT / "examples").rglob("*.jpg"))
    folders = []
    for folder in _FOLDERS:
        images = {
            path.relative_to(data)
            for kind in ("jpg", "png", "tif")
            for path in (data / folder).rglob(f"*.{kind}")
        }
        folders.append(sorted(images, key=_order))
    turns = [path for turn in itertools.zip_longest(*folders) for path in turn if path is not None]
    chosen = {f"data/{path.as_posix()}": data / path for path in turns[:_PHOTOGRAPHS]}
    return {path.as_posix(): ROOT / path for path in examples} | chosen


def answer(engine: Engine, name: str, path: Path) -> Frozen:
    """Estimate one photograph; the status of a refused one is the code of the error."""
    try:
        estimate = engine.estimate(str(path))
    except VehAnchorError as error:
        return Frozen(name, error.code, gsd_m_per_px="", low="", high="", confidence="")
    values = estimate.gsd_m_per_px, estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px
    gsd, low, high = ("" if value is None else f"{value:.4g}" for value in values)
    return Frozen(
        name,
        estimate.status,
        gsd_m_per_px=gsd,
        low=low,
        high=high,
        confidence=f"{estimate.confidence:.4f}",
    )


def equal(a: str, b: str) -> bool:
    """Return whether two cells are equal, numbers up to rounding."""
    try:
        return math.isclose(float(a), float(b), rel_tol=_EQUAL)
    except ValueError:
        return a == b


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--write", action="store_true", help="freeze today's answers")
    arguments = parser.parse_args()
    engine = Engine(runtime=Runtime(threads=1))
    started = time.process_time()
    answers = [answer(engine, name, path) for name, path in photographs(arguments.data).items()]
    seconds = f"{time.process_time() - started:.1f}"
    if arguments.write:
        with TABLE.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(
                [Frozen._fields, *answers, ("CPU seconds", seconds, *[""] * 4)]
            )
        return 0
    with TABLE.open(encoding="utf-8", newline="") as file:
        frozen = {row["file"]: Frozen(**row) for row in csv.DictReader(file)}
    changed = 0
    for now in answers:
        before = frozen.get(now.file)
        if before is None or not all(map(equal, before, now)):
            changed += 1
            print(
                f"{now.file}: {', '.join(before[1:]) if before else 'not frozen'} -> "
                f"{', '.join(now[1:])}"
            )
    print(
        f"{changed} of {len(answers)} answers changed; CPU seconds "
        f"{frozen['CPU seconds'].status} -> {seconds}"
    )
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
