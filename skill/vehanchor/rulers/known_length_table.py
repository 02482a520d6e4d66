"""Table of known lengths for many images: a CSV with one row for each line on the ground."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.errors import KnownLengthError
from vehanchor.imagery.sources.files import canonical_path
from vehanchor.options.rulers import KnownLength, Rulers
from vehanchor.records.text import count
from vehanchor.rulers.image_table import PHOTOGRAPH, read_image_table
from vehanchor.rulers.standards import check_name

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Mapping

    from vehanchor.options import ScaleOptions

KnownLengthTable: TypeAlias = "Mapping[str, tuple[KnownLength, ...]]"
"""Lines by the absolute path of their image."""

_COLUMNS = (PHOTOGRAPH, "x1", "y1", "x2", "y2", "metres")


def lines_in(
    path: str | os.PathLike[str] | None, images: Iterable[str | os.PathLike[str]]
) -> KnownLengthTable:
    """Read a CSV with the columns ``photograph``, ``x1``, ``y1``, ``x2``, ``y2`` and ``metres``.

    A name of ``vehanchor.rulers.standards`` may stand for the metres. The columns ``basis``,
    ``tolerance_m`` and ``what`` are optional; an empty cell is the default.

    Args:
        path: path of the table; an image may have several lines. Files are relative to the table.
            None for no lines.
        images: images to measure. Lines of other images are refused, because a name may be
            misspelt.

    Returns:
        The lines of each image, in pixels of the image.

    Raises:
        KnownLengthError: the table cannot be read, a row is invalid, or a line lies in another
            image.
    """
    if path is None:
        return {}
    lines = read_image_table(
        path, "known lengths", needed=_COLUMNS, read_row=_line, error=KnownLengthError
    )
    measured = {canonical_path(image) for image in images}
    strangers = sorted(set(lines) - measured)
    if strangers:
        n_others = len(strangers) - 1
        verb = "is" if n_others == 1 else "are"
        others = f", nor {verb} {count(n_others, 'other')}" if n_others else ""
        raise KnownLengthError(
            f"a line of known length is in {strangers[0]!r}, which is not one of the images"
            f"{others}: files are named relative to the table"
        )
    return lines


def with_lines_of(
    options: ScaleOptions, lines: KnownLengthTable, image: str | os.PathLike[str]
) -> ScaleOptions:
    """Add the lines of one image to the options."""
    if not lines:
        return options
    lines_of_image = lines.get(canonical_path(image))
    if lines_of_image is None:
        return options
    rulers = replace(options.rulers, known_lengths=lines_of_image)
    return replace(options, rulers=rulers)


def _line(row: Mapping[str, str | None]) -> KnownLength:
    """Read a row.

    Raises:
        ValueError: a cell is invalid.
    """
    coordinates = [row[name] for name in ("x1", "y1", "x2", "y2")]
    # An empty cell is the default.
    basis = row.get("basis") or "assumed"
    tolerance = row.get("tolerance_m") or None
    what = row.get("what") or None
    metres = row["metres"] or what
    # The options model reads the texts of the cells, as it reads those of the command line.
    values: Any = (*coordinates, metres, basis, tolerance)
    [line] = Rulers(known_lengths=(values,)).known_lengths
    check_name(line.what)
    line.check("the line of known length", KnownLengthError)
    return line
