"""Write and read the data files of results.

A benchmark prints Markdown. Inside ``recording`` its tables also go into a data file, so what is
printed and what is kept cannot differ:

    options = add_record_option(parser).parse_args()
    with recording("speed", ["search", "start"], options.record):
        print(table_of_searches, table_of_starts)

``--record`` writes the two tables under ``search`` and ``start`` of
``research/results/speed.json``; ``--record int8`` under ``search_int8`` and ``start_int8``. Without
``--record`` nothing is written. An entry has a title, the date, the command, the machine, and a
table of columns, units and rows.
"""

from __future__ import annotations

import contextlib
import datetime
import io
import json
import math
import os
import platform
import re
import statistics
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator, Mapping, Sequence

__all__ = [
    "Table",
    "add_record_option",
    "header",
    "load",
    "names_of",
    "recording",
    "spread",
    "tables_of",
    "values_table",
    "write",
]

FOLDER = Path(__file__).parent
_LINE_CHARACTERS = 118
_NUMBER = re.compile(r"([+-]?\d[\d,]*(?:\.\d+)?)(?: ?(%|s|ms|m|px|MiB))?")
_RULE = re.compile(r"\|[-:| ]+\|")

Cell = float | int | str | None


class Table(NamedTuple):
    """Table of results; ``units`` has the units of columns whose numbers have one."""

    columns: list[str]
    units: dict[str, str]
    rows: list[list[Cell]]

    def value(self, row: str, column: str) -> Cell:
        """Find a cell by its row and column.

        The name of a row is its first cell, or the first ones such as ``all / given``.
        """
        matches = [cells for cells in self.rows if row in names_of(cells)]
        if len(matches) != 1:
            raise KeyError(
                f"{len(matches)} rows are called {row!r}: {[cells[:2] for cells in self.rows]}"
            )
        return matches[0][self.columns.index(column)]


def names_of(cells: Sequence[Cell]) -> list[str]:
    """List the names of a row: its first one, two or three cells."""
    words = [str(cell) for cell in cells]
    return [" / ".join(words[:count]) for count in (1, 2, 3)]


def tables_of(markdown: str) -> list[Table]:
    """Read the tables of a Markdown text; columns of numbers with one unit become numbers."""
    lines = [line.strip() for line in markdown.splitlines()]
    tables = []
    k = 0
    while k + 1 < len(lines):
        if lines[k].startswith("|") and _RULE.fullmatch(lines[k + 1]):
            end = k + 2
            while end < len(lines) and lines[end].startswith("|"):
                end += 1
            columns = _cells(lines[k])
            texts = [_cells(line) for line in lines[k + 2 : end]]
            tables.append(_table(columns, texts))
            k = end
        else:
            k += 1
    return tables


def _cells(line: str) -> list[str]:
    cells = line.strip("|").split("|")
    return [cell.strip().replace("**", "") for cell in cells]


def _table(columns: list[str], texts: list[list[str]]) -> Table:
    units = {}
    rows = [list[Cell]() for _ in texts]
    for k, column in enumerate(columns):
        # A row that is too short has empty cells.
        cells, unit = _values([row[k] if k < len(row) else "" for row in texts])
        if unit:
            units[column] = unit
        for row, cell in zip(rows, cells, strict=True):
            row.append(cell)
    return Table(columns, units, rows)


def _values(texts: Sequence[str]) -> tuple[list[Cell], str]:
    """Convert the cells of a column; they stay texts unless all are numbers of one unit."""
    matches = [_NUMBER.fullmatch(text) for text in texts]
    is_empty = [text in {"", "-"} for text in texts]
    filled = [match for match, empty in zip(matches, is_empty, strict=True) if not empty]
    units = {match[2] or "" for match in filled if match is not None}
    if None in filled or len(units) != 1:
        return [text or None for text in texts], ""
    unit = units.pop()
    return [None if match is None else _number(match[1]) for match in matches], unit


def _number(text: str) -> float | int:
    plain = text.replace(",", "")
    return float(plain) if "." in plain else int(plain)


def add_record_option(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add ``--record [SUFFIX]``, which writes the printed tables into the topic's data file."""
    parser.add_argument(
        "--record", nargs="?", const="", metavar="SUFFIX", help="write into research/results"
    )
    return parser


@contextlib.contextmanager
def recording(
    topic: str, keys: Sequence[str], suffix: str | None, *, folder: Path = FOLDER, **facts: Any
) -> Iterator[None]:
    """Print as usual, and write the printed tables, each under its key.

    Args:
        topic: name of the data file.
        keys: keys of the tables, in the order of printing.
        suffix: suffix of every key; ``None`` writes nothing.
        folder: folder of the data files.
        facts: further fields of the entry, such as ``model``: names and checksums.
    """
    if suffix is None:
        yield
        return
    load_before = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    printed = _Copy(sys.stdout)
    with contextlib.redirect_stdout(printed):
        yield
    facts = {"command": _command(), "machine": _machine(load_before), **facts}
    for k, table in enumerate(tables_of(printed.getvalue())):
        key = keys[k] if k < len(keys) else f"{keys[-1]}_{k + 1}"
        if suffix:
            key = f"{key}_{suffix}"
        write(topic, key, table, folder=folder, **facts)


def header(*columns: str) -> str:
    """Format the two lines that begin a Markdown table."""
    return f"| {' | '.join(columns)} |\n|" + "---|" * len(columns)


def spread(values: Sequence[float], decimals: int = 2) -> list[str]:
    """Format the least, the median and the largest of repeated measurements."""
    numbers = (min(values), statistics.median(values), max(values))
    return [f"{number:.{decimals}f}" for number in numbers]


def values_table(
    values: Mapping[str, float | str], aims: Mapping[str, float | str] | None = None
) -> list[str]:
    """List the lines of a table with one quantity a row, with three significant digits."""
    columns = ["quantity", "value"]
    if aims:
        columns.append("aim")
    lines = [header(*columns)]
    for name, value in values.items():
        cells = [name, _format_value(value)]
        if aims:
            cells.append(str(aims.get(name, "")))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _format_value(value: float | str) -> str:
    if isinstance(value, str | int | np.integer):
        return str(value)
    if abs(value) >= 1000:
        return f"{value:.0f}"
    return f"{value:.3g}"


class _Copy(io.StringIO):
    """Stream that copies its text to another one."""

    def __init__(self, other: Any) -> None:
        super().__init__()
        self._other = other

    def write(self, text: str) -> int:
        self._other.write(text)
        return super().write(text)

    def flush(self) -> None:
        self._other.flush()


def _machine(load: float) -> str:
    model = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    packages = ", ".join(
        f"{name} {version(name)}" for name in ("onnxruntime", "opencv-python-headless", "numpy")
    )
    return (
        f"{os.cpu_count()} cores, {model}, load {load:.1f}; Python "
        f"{platform.python_version()}, {packages}"
    )


def _command() -> str:
    """Reconstruct the command as typed in the root of the repository."""
    main = getattr(sys.modules["__main__"], "__spec__", None)
    program = f"python -m {main.name}" if main else Path(sys.argv[0]).name
    return " ".join([program, *sys.argv[1:]])


def write(topic: str, key: str, table: Table, *, folder: Path = FOLDER, **facts: Any) -> None:
    """Write one entry, dated today; only its title and its aim stay from an earlier run."""
    path = folder / f"{topic}.json"
    entries = load(topic, folder) if path.exists() else {}
    earlier = entries.get(key, {"title": key})
    entry = {name: value for name, value in earlier.items() if name in {"title", "aim"}}
    today = datetime.date.today().isoformat()
    entries[key] = {**entry, "date": today, **facts, **table._asdict()}
    path.write_text(f"{_dump(entries, 0)}\n", encoding="utf-8")


def load(topic: str, folder: Path = FOLDER) -> dict[str, dict[str, Any]]:
    """Load the entries of a topic by their keys."""
    text = (folder / f"{topic}.json").read_text(encoding="utf-8")
    entries: dict[str, dict[str, Any]] = json.loads(text)
    return entries


def _dump(value: Any, depth: int) -> str:
    """Format JSON with one line for each row of a table."""
    line = _json(value)
    if not isinstance(value, (dict, list)) or not value:
        return line
    if depth and len(line) + depth <= _LINE_CHARACTERS:
        return line
    inner = "  " * (depth + 1)
    outer = "  " * depth
    if isinstance(value, dict):
        parts = [f"{inner}{_json(key)}: {_dump(item, depth + 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(parts) + "\n" + outer + "}"
    if not any(isinstance(item, (dict, list)) for item in value):
        return line
    parts = [f"{inner}{_json(item)}" for item in value]
    return "[\n" + ",\n".join(parts) + "\n" + outer + "]"


def _json(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
