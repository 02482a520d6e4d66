"""Table files: Parquet, CSV or JSON lines by suffix, written completely or not at all."""

from __future__ import annotations

import csv
from importlib.util import find_spec
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.errors import MissingExtraError, how_to_install
from vehanchor.records.columns import COLUMNS
from vehanchor.records.escaping import as_json, in_cell
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

_CHUNK_ROWS = 4096  # rows that the Parquet writer holds in memory

Rows: TypeAlias = "Iterable[Mapping[str, Any]]"
"""Values by column."""

Columns: TypeAlias = "Mapping[str, type]"
"""Names of the columns and types of their values, in order."""


def check_table_path(path: Path) -> Path:
    """Check, before the work, that a table can be written to a path.

    Raises:
        OutputError: the suffix is unknown, the folder does not exist, or the path is a folder.
        MissingExtraError: pyarrow is not installed (Parquet).
    """
    check_output_path(
        path, tuple(_WRITERS), kind="a table", also=".geojson holds the targets of --measure"
    )
    if path.suffix.lower() == ".parquet" and find_spec("pyarrow") is None:
        raise MissingExtraError(
            f"writing Parquet needs pyarrow: {how_to_install('parquet')}, or write .csv or .jsonl"
        )
    return path


def write_table(path: Path, rows: Rows, columns: Columns = COLUMNS) -> None:
    """Write rows; they replace an existing file when all are written.

    Args:
        path: ``.parquet``, ``.csv`` or ``.jsonl``, checked by ``check_table_path``.
        rows: values by column, in order; they need not fit in memory.
        columns: names of the columns and types of their values, in order; other values of a row
            are left out.

    Raises:
        OutputError: the file cannot be written.
    """
    write = _WRITERS[path.suffix.lower()]
    with whole_file(path) as partial:
        write(partial, rows, columns)


def _write_jsonl(path: Path, rows: Rows, columns: Columns) -> None:
    with path.open("w", encoding="ascii", newline="\n") as file:
        for row in rows:
            values = {name: row[name] for name in columns}
            file.write(f"{as_json(values)}\n")


def _write_csv(path: Path, rows: Rows, columns: Columns) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            cells = {name: in_cell(row[name]) for name in columns}
            writer.writerow(cells)


def _write_parquet(path: Path, rows: Rows, columns: Columns) -> None:
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    arrow_types = {
        float: arrow.float64(),
        int: arrow.int64(),
        bool: arrow.bool_(),
        str: arrow.string(),
    }
    fields = [(name, arrow_types[kind]) for name, kind in columns.items()]
    schema = arrow.schema(fields)
    remaining = iter(rows)
    with parquet.ParquetWriter(path, schema) as writer:
        while chunk := list(islice(remaining, _CHUNK_ROWS)):
            chunk_table = arrow.Table.from_pylist(chunk, schema=schema)
            writer.write_table(chunk_table)


_WRITERS: dict[str, Callable[[Path, Rows, Columns], None]] = {
    ".parquet": _write_parquet,
    ".csv": _write_csv,
    ".jsonl": _write_jsonl,
}
