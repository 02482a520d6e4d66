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
    """A table of results; ``units`` names those of the columns whose numbers have one."""

    columns: list[str]
    units: dict[str, str]
    rows: list[list[Cell]]

    def value(self, row: str, column: str) -> Cell:
        """A cell, by its row (the first cell, or the first ones as ``all / given``) and the name of its column."""
        found = [cells for cells in self.rows if row in names_of(cells)]
        if len(found) != 1:
            raise KeyError(
                f"{len(found)} rows are called {row!r}: {[cells[:2] for cells in self.rows]}"
            )
        return found[0][self.columns.index(column)]


def names_of(cells: Sequence[Cell]) -> list[str]:
    """List the names of a row: its first one, two or three cells."""
    return [" / ".join(str(cell) for cell in cells[:count]) for count in (1, 2, 3)]


def tables_of(markdown: str) -> list[Table]:
    """Read the tables of a Markdown text; a column whose cells are all numbers of one unit becomes numbers."""
    lines = [line.strip() for line in markdown.splitlines()]
    tables = []
    k = 0
    while k + 1 < len(lines):
        if lines[k].startswith("|") and _RULE.fullmatch(lines[k + 1]):
            end = k + 2
            while end < len(lines) and lines[end].startswith("|"):
                end += 1
            tables.append(_table(_cells(lines[k]), [_cells(line) for line in lines[k + 2 : end]]))
            k = end
        else:
            k += 1
    return tables


def _cells(line: str) -> list[str]:
    return [cell.strip().replace("**", "") for cell in line.strip("|").split("|")]


def _table(columns: list[str], texts: list[list[str]]) -> Table:
    units = {}
    rows = [list[Cell]() for _ in texts]
    for k, column in enumerate(columns):
        cells, unit = _values([row[k] if k < len(row) else "" for row in texts])
        if unit:
            units[column] = unit
        for row, cell in zip(rows, cells, strict=True):
            row.append(cell)
    return Table(columns, units, rows)


def _values(texts: Sequence[str]) -> tuple[list[Cell], str]:
    """The cells of a column and their unit; texts, where they are not all numbers of one unit."""
    found = [None if text in {"", "-"} else _NUMBER.fullmatch(text) for text in texts]
    said = [match for text, match in zip(texts, found, strict=True) if text not in {"", "-"}]
    units = {match[2] or "" if match else None for match in said}
    if len(units) != 1 or None in units:
        return [text or None for text in texts], ""
    return [None if match is None else _number(match[1]) for match in found], units.pop() or ""


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
    """Print as always, and write the printed tables under their keys, one each.

    Args:
        topic: names the data file.
        keys: of the tables, in the order in which they are printed.
        suffix: of every key; ``None`` writes nothing.
        folder: of the data files.
        facts: more of the entry, such as ``model``: names and checksums.
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
        write(topic, f"{key}_{suffix}" if suffix else key, table, folder=folder, **facts)


def header(*columns: str) -> str:
    """The two lines that begin a Markdown table."""
    return f"| {' | '.join(columns)} |\n|" + "---|" * len(columns)


def values_table(
    values: Mapping[str, float | str], aims: Mapping[str, float | str] | None = None
) -> list[str]:
    """The lines of a table with one quantity a row; three significant digits, or all of a whole number."""
    lines = [header("quantity", "value", "aim") if aims else header("quantity", "value")]
    for name, value in values.items():
        cells = [name, _shown(value), *([str(aims.get(name, ""))] if aims else [])]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _shown(value: float | str) -> str:
    if isinstance(value, str | int | np.integer):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


class _Copy(io.StringIO):
    """A stream that keeps what it passes on."""

    def __init__(self, shown: Any) -> None:
        super().__init__()
        self._shown = shown

    def write(self, text: str) -> int:
        self._shown.write(text)
        return super().write(text)

    def flush(self) -> None:
        self._shown.flush()


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
    """Give the command as typed in the root of the repository."""
    main = getattr(sys.modules["__main__"], "__spec__", None)
    program = f"python -m {main.name}" if main else Path(sys.argv[0]).name
    return " ".join([program, *sys.argv[1:]])


def write(topic: str, key: str, table: Table, *, folder: Path = FOLDER, **facts: Any) -> None:
    """Write one entry, dated today; its title and its aim stay, everything else is of this run."""
    entries = load(topic, folder) if (folder / f"{topic}.json").exists() else {}
    kept = {
        name: value
        for name, value in entries.get(key, {"title": key}).items()
        if name in {"title", "aim"}
    }
    entries[key] = {**kept, "date": datetime.date.today().isoformat(), **facts, **table._asdict()}
    (folder / f"{topic}.json").write_text(f"{_dump(entries, 0)}\n", encoding="utf-8")


def load(topic: str, folder: Path = FOLDER) -> dict[str, dict[str, Any]]:
    """The entries of a topic by their keys."""
    found: dict[str, dict[str, Any]] = json.loads(
        (folder / f"{topic}.json").read_text(encoding="utf-8")
    )
    return found


def _dump(value: Any, depth: int) -> str:
    """JSON with one row of a table a line."""
    line = json.dumps(value, ensure_ascii=False)
    if (
        not isinstance(value, (dict, list))
        or (depth and len(line) + depth <= _LINE_CHARACTERS)
        or not value
    ):
        return line
    space = "  " * (depth + 1)
    if isinstance(value, dict):
        parts = [
            f"{space}{json.dumps(key, ensure_ascii=False)}: {_dump(each, depth + 1)}"
            for key, each in value.items()
        ]
        return "{\n" + ",\n".join(parts) + "\n" + "  " * depth + "}"
    if not any(isinstance(each, (dict, list)) for each in value):
        return line
    parts = [f"{space}{json.dumps(each, ensure_ascii=False)}" for each in value]
    return "[\n" + ",\n".join(parts) + "\n" + "  " * depth + "]"
