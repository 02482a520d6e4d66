"""Compare the chances of answers with the share that is right, in bins of 100 photographs.

``python -m research.benchmarks.calibration ANSWERS.csv``. Prints Markdown; ``--record`` keeps it,
and ``--record unseen`` the table of photographs that no network has learned from.
``research.results.page`` draws both.
The table has a row for each photograph of known scale, with the columns ``true_gsd_m_per_px``,
``gsd_m_per_px``, ``confidence`` and ``n_vehicles``; photographs without a scale are left out of it.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.results.record import add_record_option, recording

if TYPE_CHECKING:
    from collections.abc import Sequence

_LARGEST_ERROR = 0.2
_BIN = 100
# Fewest and most cars of a group.
_GROUPS = {"none": (0, 0), "1 to 4": (1, 4), "5 and more": (5, 100_000)}


class Answer(NamedTuple):
    """Answer about one photograph."""

    chance: float
    is_right: bool
    n_vehicles: int


def read_answers(table: Path) -> list[Answer]:
    """Read the answers of a table."""
    answers = []
    with table.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            ratio = float(row["gsd_m_per_px"]) / float(row["true_gsd_m_per_px"])
            is_right = abs(ratio - 1) <= _LARGEST_ERROR
            answers.append(Answer(float(row["confidence"]), is_right, int(row["n_vehicles"])))
    return answers


def rows_of_group(name: str, answers: Sequence[Answer]) -> list[str]:
    """Format a row of the table for each bin of a group, the least sure answers first."""
    ordered = sorted(answers, key=lambda answer: answer.chance)
    rows = []
    for start in range(0, len(ordered), _BIN):
        answers_of_bin = ordered[start : start + _BIN]
        n = len(answers_of_bin)
        chance = float(np.mean([answer.chance for answer in answers_of_bin]))
        right = float(np.mean([answer.is_right for answer in answers_of_bin]))
        standard_error = math.sqrt(chance * (1 - chance) / n)
        deviation = (right - chance) / standard_error
        rows.append(
            f"| {name} | {n} | {100 * chance:.1f} % | {100 * right:.1f} % | {deviation:+.1f} |"
        )
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("answers", type=Path)
    options = add_record_option(parser).parse_args()
    answers = read_answers(options.answers)
    with recording("scale", ["calibration"], options.record):
        print("| cars | photographs | chance | right | standard errors |")
        print("|---|---|---|---|---|")
        for name, (fewest, most) in _GROUPS.items():
            group = [answer for answer in answers if fewest <= answer.n_vehicles <= most]
            for row in rows_of_group(name, group):
                print(row)


if __name__ == "__main__":
    main()
