"""Tables about many images: a CSV whose rows each name the image that they belong to."""

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
_MOST_BYTES = 64 << 20


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
        content: what the rows are, for messages.
        needed: columns without which the table is refused.
        read_row: reads a row; its ``ValueError`` gets the number of the line.
        error: class of the errors raised.
        optional: further columns that a message shows.

    Returns:
        The rows of each image, by its absolute path, in order.

    Raises:
        InvalidParameterError: of the class ``error``: the table cannot be read, has no row, or a
            row is invalid.
    """
    table = Path(path)
    found: dict[str, tuple[_Row, ...]] = {}
    try:
        if table.stat().st_size > _MOST_BYTES:
            raise error(
                f"{str(table)!r} is larger than {_MOST_BYTES >> 20} MiB: give a table of {content}"
            )
        with table.open(newline="", encoding="utf-8-sig") as handle:
            reader = csv.DictReader(handle)
            missing = [name for name in needed if name not in (reader.fieldnames or ())]
            if missing:
                first = ",".join((*needed, *optional))
                raise error(
                    f"{str(table)!r} has no column {', '.join(missing)}: the first line must be "
                    f"{first}"
                )
            for row in reader:
                file = row["file"] or ""
                try:
                    if not file:
                        raise error("the file is not named")
                    read = read_row(row)
                except ValueError as problem:
                    raise error(f"{str(table)!r}, line {reader.line_num}: {problem}") from None
                image = canonical_path(table.parent / file)
                found[image] = (*found.get(image, ()), read)
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise error(f"cannot read the {content} in {str(table)!r}: {problem}") from None
    if not found:
        raise error(f"{str(table)!r} has no {content}: give at least one")
    return found
