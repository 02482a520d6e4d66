"""Tables about many images: a CSV in which each row names its image."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from vehanchor.imagery.sources.files import canonical_path
from vehanchor.storage.text import decoded

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence
    from typing import TypeAlias

    from vehanchor.errors import InvalidParameterError

    Cells: TypeAlias = Mapping[str, str | None]
    """Text of a line's cells by column; None for cells that the line lacks."""

_Row = TypeVar("_Row")
PHOTOGRAPH = "photograph"
"""Column that names the image of a row."""
# Former name of that column.
_FORMER_COLUMN = "file"
_MAX_BYTES = 64 << 20
# A choice above what spreadsheets of measurements have.
_MAX_COLUMNS = 1_000
_DELIMITERS = (",", ";", "\t", "|")
# First bytes of files that spreadsheets and archivers write in place of text.
_NO_TEXT = {
    b"PK\3\4": "a workbook of a spreadsheet: save it as CSV",
    b"\xd0\xcf\x11\xe0": "a workbook of a spreadsheet: save it as CSV",
    b"\x1f\x8b": "compressed: unpack it",
}
_STATED_DELIMITER = re.compile(r"sep=.\s*", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
# Beside commas as delimiters, as in English tables, a comma can separate thousands.
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")


def read_image_table(
    path: str | os.PathLike[str],
    content: str,
    needed: Sequence[str],
    read_row: Callable[[Cells], _Row],
    error: type[InvalidParameterError],
    *,
    optional: Sequence[str] = (),
) -> dict[str, tuple[_Row, ...]]:
    """Read a CSV with a row per thing in an image, which its column ``photograph`` names.

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
    rows: dict[str, list[_Row]] = {}
    try:
        if table.stat().st_size > _MAX_BYTES:
            raise error(
                f"{str(table)!r} is larger than {_MAX_BYTES >> 20} MiB: give a table of {content}"
            )
        columns, lines = read_table(table.read_bytes(), needed)
        missing = [name for name in needed if name not in columns]
        if missing:
            first_line = ",".join((*needed, *optional))
            raise error(
                f"{str(table)!r} has no column {', '.join(missing)}: the first line must be "
                f"{first_line}"
            )
        for number, cells in lines:
            try:
                file = cells[PHOTOGRAPH] or ""
                if not file:
                    raise error("the photograph is not named")
                row = read_row(cells)
                # A name with a NUL is none.
                image = canonical_path(_existing(table.parent, file))
            except ValueError as problem:
                raise error(f"{str(table)!r}, line {number}: {problem}") from None
            rows.setdefault(image, []).append(row)
    except (OSError, UnicodeDecodeError, csv.Error) as problem:
        raise error(f"cannot read the {content} in {str(table)!r}: {problem}") from None
    if not rows:
        raise error(f"{str(table)!r} has no {content}: give at least one")
    return {image: tuple(own_rows) for image, own_rows in rows.items()}


def _existing(folder: Path, file: str) -> Path:
    """Find a file of a table, which may have been written on Windows."""
    path = folder / file
    if path.exists() or "\\" not in file:
        return path
    return folder / file.replace("\\", "/")


class Table(NamedTuple):
    """Cells of a CSV.

    Attributes:
        columns: names of the first line.
        lines: number of each further line, and its cells by column; without empty lines.
    """

    columns: list[str]
    lines: list[tuple[int, Cells]]


def read_table(content: bytes, needed: Sequence[str]) -> Table:
    """Read a CSV as spreadsheets of all countries write it.

    Args:
        content: the file.
        needed: columns by which the delimiter is recognised, in small letters.

    Raises:
        UnicodeDecodeError: the encoding is unknown.
        csv.Error: it is a workbook or not a CSV, has too many columns or one column twice, or a
            line has more cells than columns.
    """
    for signature, reason in _NO_TEXT.items():
        if content.startswith(signature):
            raise csv.Error(f"it is {reason}")
    with io.StringIO(decoded(content), newline="") as handle:
        start = _start_of_table(handle, needed)
        reader = csv.DictReader(handle, delimiter=start.delimiter)
        columns = _with_current_name(reader.fieldnames or ())
        # A row is completed by an empty cell for each column that it lacks.
        if len(columns) > _MAX_COLUMNS:
            raise csv.Error(f"it has {len(columns)} columns: give at most {_MAX_COLUMNS}")
        reader.fieldnames = columns
        for name in needed:
            if columns.count(name) > 1:
                raise csv.Error(f"the column {name} has two places")
        lines: list[tuple[int, Cells]] = []
        for row in reader:
            number = start.n_lines + reader.line_num
            surplus = row.pop(None, ())
            if any(surplus):
                raise csv.Error(
                    f"line {number} has more cells than the first line; a number with a "
                    "decimal comma needs quotes or another delimiter"
                )
            cells: Cells = {name: text and text.strip() for name, text in row.items()}
            if not any(cells.values()):
                continue  # spreadsheets write rows of empty cells
            cells = _with_decimal_points(cells, start.delimiter)
            lines.append((number, cells))
    return Table(columns, lines)


class _Start(NamedTuple):
    """Start of a table, after which its first line follows.

    Attributes:
        n_lines: number of lines before the first one.
        delimiter: the delimiter of its cells.
    """

    n_lines: int
    delimiter: str


def _start_of_table(handle: io.StringIO, needed: Sequence[str]) -> _Start:
    """Find the first line of a table, and the delimiter at which it has most of the needed columns.

    Empty lines before it are passed over, and one that states the delimiter, as Excel writes it.
    """
    n_lines = 0
    place = 0
    first_line = handle.readline()
    while first_line and (not first_line.strip() or _STATED_DELIMITER.fullmatch(first_line)):
        n_lines += 1
        place = handle.tell()
        first_line = handle.readline()
    handle.seek(place)

    def n_found(delimiter: str) -> int:
        names = next(csv.reader([first_line], delimiter=delimiter), [])
        return len(set(needed).intersection(_with_current_name(names)))

    return _Start(n_lines, max(_DELIMITERS, key=n_found))


def _with_current_name(columns: Sequence[str]) -> list[str]:
    """Rename the former column of the images; names are in small letters, without spaces."""
    names = [name.strip().casefold() for name in columns]
    if PHOTOGRAPH in names:
        return names
    return [PHOTOGRAPH if name == _FORMER_COLUMN else name for name in names]


def _with_decimal_points(cells: Cells, delimiter: str) -> Cells:
    """Replace the decimal commas of numbers; commas that may separate thousands stay."""
    replaced = {}
    for name, text in cells.items():
        replaced[name] = text
        if not text or not _DECIMAL_COMMA.fullmatch(text):
            continue
        if delimiter != "," or not _THOUSANDS.fullmatch(text):
            replaced[name] = text.replace(",", ".")
    return replaced
