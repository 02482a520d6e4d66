"""Stored chips, which are larger than a chip so that training can turn, scale and shift them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from vehanchor.storage.atomic import whole_file

Chips: TypeAlias = NDArray[np.uint8]
"""Chips ``[n, h, w, 3]``."""

Values: TypeAlias = NDArray[np.float32]
"""A number ``[n]`` of each chip."""

Types: TypeAlias = NDArray[np.int8]
"""A class ``[n]`` of each chip; negative if unknown."""

Names: TypeAlias = NDArray[np.str_]
"""A name ``[n]`` of each chip."""

STORED_PX = 144
# Length of the candidate on a stored chip, which shows four lengths of context.
STORED_LENGTH_PX = 36.0
UNKNOWN = -1
_CHIPS = "chips.npy"
_TABLE = "table.npz"


class Rows(NamedTuple):
    """Targets and sources of stored chips, one row each.

    Attributes:
        car: 1 for a car in a fitting box, 0 for anything else.
        type: index into ``KINDS``, or -1.
        box: ``[n, 5]`` the true box relative to the candidate: centre along and across in candidate
            lengths, log of the length and width over the candidate's length, turn in radians; NaN
            where unknown.
        log_length_m: log of the true length in metres, NaN where unknown.
        length_px: of the candidate in its source image: how much detail there is.
        score: the detector's, 0 where it did not find the box.
        combined: the score of the verifier, 0 likewise.
        sets: names of data sets.
        files: names of source images.
    """

    car: Types
    type: Types
    box: NDArray[np.float32]
    log_length_m: Values
    length_px: Values
    score: Values
    combined: Values
    sets: Names
    files: Names

    def take(self, which: NDArray[np.intp] | NDArray[np.bool_]) -> Rows:
        """Select rows by a mask or by indices."""
        return Rows(*(column[which] for column in self))  # type: ignore[arg-type]

    @classmethod
    def unlabelled(cls, lengths_px: NDArray[np.floating], set_name: str, file: str) -> Rows:
        """Make rows of candidates of these lengths: not cars, of unknown type, found by nobody."""
        count = len(lengths_px)
        nothing = np.zeros(len(lengths_px), np.float32)
        return cls(
            np.zeros(count, np.int8), np.full(count, UNKNOWN, np.int8),
            np.full((count, 5), np.nan, np.float32), np.full(count, np.nan, np.float32),
            lengths_px.astype(np.float32), nothing, nothing, np.full(count, set_name),
            np.full(count, file),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: Sequence[Rows]) -> Rows:
        """Join all rows, one part after the other."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))


@dataclass
class ChipStore:
    """Chips and their rows while they are collected."""

    chips: list[Chips] = field(default_factory=list)
    rows: list[Rows] = field(default_factory=list)

    def add(self, chips: Chips, rows: Rows) -> None:
        """Add chips ``[n, 144, 144, 3]``."""
        if len(chips):
            self.chips.append(chips)
            self.rows.append(rows)

    def save(self, folder: Path) -> Rows:
        """Write both files; the table last, so that a table means whole chips."""
        folder.mkdir(parents=True, exist_ok=True)
        rows = Rows.joined(self.rows)
        with whole_file(folder / _CHIPS) as partial, partial.open("wb") as handle:
            shape = (len(rows.car), STORED_PX, STORED_PX, 3)
            header = {"descr": "|u1", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(handle, header)
            for part in self.chips:
                handle.write(np.ascontiguousarray(part).data)
        with whole_file(folder / _TABLE) as partial, partial.open("wb") as handle:
            np.savez(handle, **rows._asdict())
        return rows


def read_store(folder: Path) -> tuple[Chips, Rows]:
    """Memory-mapped chips and their rows."""
    with np.load(folder / _TABLE) as table:
        rows = Rows(**{name: table[name] for name in Rows._fields})
    chips = np.load(folder / _CHIPS, mmap_mode="r")
    if len(chips) != len(rows.car):
        raise ValueError(f"{folder}: {len(chips)} chips, but {len(rows.car)} rows")
    return chips, rows
