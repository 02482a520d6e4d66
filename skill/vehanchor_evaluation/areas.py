"""Objects of known area: a folder with an ``index.csv`` and label images.

The index has the columns ``image`` and ``mask`` (relative to the folder), ``category``,
``gsd_m_per_px``, and optionally ``split``. A label image has 8 or 16 bit. Each number in it is an
object, and 0 is the background. An image can have several label images.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.files import canonical_path
from vehanchor.measure.id_image import read_masks
from vehanchor.rulers.image_table import read_table
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.models.runtime import Progress

    Mask: TypeAlias = NDArray[np.bool_]
    """Pixels ``[h, w]`` of an object."""

    IndexLine: TypeAlias = tuple[int, Mapping[str, str | None]]
    """Number of a line of the index, and its cells by column."""

# Shorter side of an object's box; smaller objects are too coarse for a mask.
MIN_SIDE_PX = 15
INDEX = "index.csv"
COLUMNS = ("image", "mask", "category", "gsd_m_per_px")


@dataclass(frozen=True, eq=False)
class AreaEntry:
    """Object whose area is requested.

    Attributes:
        name: mask and number.
        image: path of the image.
        mask_file: path of its label image.
        category: its category.
        gsd_m_per_px: true GSD of the image.
        left_px: column of the mask's first pixel in the image.
        top_px: row of the mask's first pixel in the image.
        mask: ``[h, w]`` bool, its true mask, cropped to its box.
    """

    name: str
    image: Path
    mask_file: Path
    category: str
    gsd_m_per_px: float
    left_px: int
    top_px: int
    mask: Mask

    @property
    def mask_area_px(self) -> int:
        """Pixels of its true mask."""
        return int(self.mask.sum())

    @property
    def area_m2(self) -> float:
        """True area, ``mask_area_px * GSD^2``."""
        return self.mask_area_px * self.gsd_m_per_px**2

    @property
    def corners(self) -> tuple[float, float, float, float]:
        """Box as a prompt: x1, y1, x2, y2; the image's first pixel spans 0 to 1."""
        height, width = self.mask.shape
        right_px = self.left_px + width
        bottom_px = self.top_px + height
        return self.left_px, self.top_px, right_px, bottom_px


class AreaSet(NamedTuple):
    """Objects of a folder.

    Attributes:
        source: the folder.
        sha256: SHA-256 of its index, which results refer to.
        entries: the objects; categories alternate, so any number of first entries is balanced.
        issues: rows and files that could not be used.
    """

    source: Path
    sha256: str
    entries: tuple[AreaEntry, ...]
    issues: tuple[FileIssue, ...]


class _Row(NamedTuple):
    image: Path
    mask: Path
    name: str
    category: str
    gsd_m_per_px: float


def read_areas(
    folder: Path,
    split: str | None = None,
    *,
    workers: int = 1,
    progress: Progress | None = None,
) -> AreaSet:
    """Read the objects of a folder.

    Args:
        folder: folder with ``index.csv``.
        split: use only rows of this split; None uses all.
        workers: masks read in parallel.
        progress: called with (masks read, total).

    Raises:
        InvalidParameterError: the index or a column is missing, the split has no rows, or there is
            no object.
    """
    rows, issues = _usable_rows(folder, split)
    entries: list[AreaEntry] = []
    with ThreadPoolExecutor(workers) as pool:
        for done, objects in enumerate(pool.map(_entries, rows), start=1):
            if isinstance(objects, FileIssue):
                issues.append(objects)
            else:
                entries += objects
            if progress is not None:
                progress(done, len(rows))
    if not entries:
        message = f"{folder} has no object of {MIN_SIDE_PX} px and more"
        if issues:
            issue = issues[0]
            message += f"; the first problem: {issue.file}: {issue.message}"
        raise InvalidParameterError(message)
    index_bytes = (folder / INDEX).read_bytes()
    sha256 = hashlib.sha256(index_bytes).hexdigest()
    alternating = tuple(_alternating(entries))
    return AreaSet(folder, sha256, entries=alternating, issues=tuple(issues))


def _usable_rows(folder: Path, split: str | None) -> tuple[list[_Row], list[FileIssue]]:
    """Read the rows of a split, and list the rows that are malformed or repeated."""
    index = folder / INDEX
    rows = []
    issues = []
    # The name of a mask identifies its objects in the log, so it may occur only once.
    names = set()
    for line, cells in _lines_of_split(index, split):
        row = _row(folder, cells)
        if row is None:
            message = f"line {line}: expected {','.join(COLUMNS)}, gsd > 0"
            issues.append(FileIssue(index, "malformed_row", message))
        elif row.name in names:
            message = f"line {line}: {cells['mask']} is already listed"
            issues.append(FileIssue(index, "duplicate_name", message))
        else:
            names.add(row.name)
            rows.append(row)
    return rows, issues


def _lines_of_split(index: Path, split: str | None) -> list[IndexLine]:
    """Read the lines of a split, at least one; None selects all."""
    lines = _index_lines(index)
    lines_of_split = lines
    if split is not None:
        lines_of_split = [line for line in lines if line[1].get("split") == split]
    if not lines_of_split:
        splits = {cells.get("split") or "" for _, cells in lines}
        available = ", ".join(sorted(splits)) or "no rows"
        raise InvalidParameterError(f"{index} has no rows of split {split!r}: it has {available}")
    return lines_of_split


def _index_lines(index: Path) -> list[IndexLine]:
    """Read the cells of each row by column, with the number of its line."""
    try:
        columns, lines = read_table(index.read_bytes(), COLUMNS)
        missing = [column for column in COLUMNS if column not in columns]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidParameterError(
            f"{index}: {error}; give a folder with an index.csv of masks"
        ) from None
    if missing:
        absent = ", ".join(missing)
        needed = ", ".join(COLUMNS)
        raise InvalidParameterError(f"{index} has no column {absent}: it needs {needed}")
    return lines


def _row(folder: Path, cells: Mapping[str, str | None]) -> _Row | None:
    """Parse a row; None if it is malformed."""
    image, mask, category, gsd_text = [cells[column] or "" for column in COLUMNS]
    try:
        gsd = float(gsd_text)
    except ValueError:
        return None
    if not (image and mask and category):
        return None
    if not math.isfinite(gsd) or gsd <= 0:
        return None
    return _Row(
        image=Path(canonical_path(folder / image)),
        mask=folder / mask,
        name=str(Path(mask).with_suffix("")),
        category=category,
        gsd_m_per_px=gsd,
    )


def _entries(row: _Row) -> list[AreaEntry] | FileIssue:
    """Read the objects of a row, or state why there are none."""
    if not row.image.is_file():
        message = "it has a mask, but there is no such file"
        return FileIssue(row.image, "no_image", message)
    try:
        objects = list(read_masks(row.mask))
    except (OSError, ValueError) as error:
        return FileIssue(row.image, "unreadable_masks", str(error))
    return [
        AreaEntry(
            f"{row.name}-{number}",
            row.image,
            mask_file=row.mask,
            category=row.category,
            gsd_m_per_px=row.gsd_m_per_px,
            left_px=left,
            top_px=top,
            mask=mask,
        )
        for number, left, top, mask in objects
        if min(mask.shape) >= MIN_SIDE_PX
    ]


def _alternating(entries: Sequence[AreaEntry]) -> list[AreaEntry]:
    """Sort the entries so that categories alternate: the first of each, the second of each."""
    n_earlier: Counter[str] = Counter()

    def rank_in_category(entry: AreaEntry) -> int:
        n_earlier[entry.category] += 1
        return n_earlier[entry.category]

    return sorted(entries, key=rank_in_category)
