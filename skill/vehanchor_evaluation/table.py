"""Table of images of known scale: a CSV with the columns ``file`` and ``gsd_m_per_px``."""

from __future__ import annotations

import csv
import math
from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError
from vehanchor.rulers.image_table import PHOTOGRAPH, read_table
from vehanchor_evaluation.known_scale import (
    FileIssue,
    KnownScaleImage,
    KnownScaleSet,
    labels_beside,
)

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_COLUMNS = (PHOTOGRAPH, "gsd_m_per_px")


def survey_table(path: Path) -> KnownScaleSet:
    """Read a table and find the labels of its images; invalid lines become issues.

    The column ``file`` is relative to the table. The columns ``set``, ``split`` and
    ``labelled_small_vehicles`` are optional.

    Raises:
        InvalidParameterError: the table cannot be read, or lacks the columns.
    """
    images = []
    issues = []
    n_rows = 0
    n_malformed = 0
    try:
        _, lines = read_table(path.read_bytes(), _COLUMNS)
        for number, row in lines:
            n_rows += 1
            try:
                image = _image(path, number, row)
            except InvalidParameterError as error:
                n_malformed += 1
                issues.append(FileIssue(path, "malformed_row", str(error)))
                continue
            if not image.path.is_file():
                message = f"line {number} of the table: no such file"
                issues.append(FileIssue(image.path, "no_image", message))
                continue
            labels = labels_beside(image.path)
            images.append(image._replace(labels=labels))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidParameterError(f"cannot read table {str(path)!r}: {error}") from None
    # If no line is valid, the user probably named the wrong file.
    if n_rows and n_malformed == n_rows:
        raise InvalidParameterError(
            f"no line of the table can be used; the first problem: {issues[0].message}"
        )
    return KnownScaleSet(str(path), tuple(images), tuple(issues)).without_duplicates()


def _image(path: Path, number: int, row: Mapping[str, str | None]) -> KnownScaleImage:
    """Parse a row of the table, which stands on the line of this number."""
    try:
        gsd = float(row["gsd_m_per_px"] or "")
        file = row[PHOTOGRAPH] or ""
        vehicles = row.get("labelled_small_vehicles")
        n_vehicles = None
        if vehicles:
            n_vehicles = int(vehicles)
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidParameterError(
            f"{path}, line {number}: expected file,gsd_m_per_px ({error})"
        ) from None
    if not file:
        raise InvalidParameterError(f"{path}, line {number}: the column file is empty")
    is_positive = math.isfinite(gsd) and gsd > 0
    if not is_positive:
        raise InvalidParameterError(
            f"{path}, line {number}: gsd_m_per_px is {gsd}, not a positive number"
        )
    return KnownScaleImage(
        path.parent / file,
        gsd,
        set=row.get("set") or "",
        split=row.get("split") or "",
        labelled_vehicles=n_vehicles,
    )
