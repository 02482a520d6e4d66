"""Tables about many images: a CSV in which each row names its image."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from vehanchor.imagery.sources.files import canonical_path

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence

    from vehanchor.errors import InvalidParameterError

    Cells = Mapping[str, str | None]

_Row = TypeVar("_Row")
_MAX_BYTES = 64 << 20


def read_image_table(
    path: str | os.PathLike[str],
    content: str,
    needed: Sequence[str],
    read_row: Callable[[Cells], _Row],
    error: type[InvalidParameterError],
    *,
    optional: Sequence[str] = (),
) -> dict[str, tuple[_Row, ...]]:
    """Read a CSV with a row per thing in an image, which its column ``file`` names.

    Args:
        path: path of the table. Files are relative to the table.
        content: noun for the rows, in messages.
        needed: columns without which the table is refused.
        read_row: function that reads the cells of a row; its ``ValueError`` is raised again with
            the number of the line.
        error: class of the errors raised.
        optional: further columns that messages show.

    Returns:
        The rows of each image, by its absolute path, in order.

    Raises:
        InvalidParameterError: of the class ``error``: the table cannot be read, has no row, or a
            row is invalid.
    """
    table = Path(path)
    rows: dict[str, tuple[_Row, ...]] = {}
    try:
        if table.stat().st_size > _MAX_BYTES:
            raise error(
                f"{str(table)!r} is larger than {_MAX_BYTES >> 20} MiB: give a table of {content}"
            )
        with table.open(newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle)
            columns = reader.fieldnames or ()
            missing = [name for name in needed if name not in columns]
            if missing:
                first_line = ",".join((*needed, *optional))
                raise error(
                    f"{str(table)!r} has no column {', '.join(missing)}: the first line must be "
                    f"{first_line}"
                )
            for cells in reader:
                file = cells["file"] or ""
                try:
                    if not file:
                        raise error("the file is not named")
                    row = read_row(cells)
                except ValueError as problem:
                    raise error(f"{str(table)!r}, line {reader.line_num}: {problem}") from None
                image = canonical_path(table.parent / file)
                earlier_rows = rows.get(image, ())
                rows[image] = (*earlier_rows, row)
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise error(f"cannot read the {content} in {str(table)!r}: {problem}") from None
    if not rows:
        raise error(f"{str(table)!r} has no {content}: give at least one")
    return rows
