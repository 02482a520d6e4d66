"""Generate the page of results from the data files: ``python -m research.results.page [--check]``.

``page.md`` is the template and ``README.md`` the page, with the figure ``calibration.svg``.
``quotes.json`` lists what other documents quote. Placeholders:

* ``{{scale.val | labelled, all sets | median}}``: a cell by entry, row and column, with its unit;
  ``| .1f`` rounds it;
* ``{{table scale.val | n; median = median error | rows labelled}}``: a table with some columns,
  renamed, and some rows;
* ``{{index}}``: the data files and their entries.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from functools import cache
from typing import TYPE_CHECKING, Any

from research.results.figure import calibration_figure
from research.results.record import FOLDER, Table, load, names_of

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["TOPICS", "main", "missing_quotes", "page", "render"]

ROOT = FOLDER.parents[1]
TOPICS = ("scale", "detection", "rulers", "areas", "flights", "speed", "server", "agents")
_TABLE = re.compile(r"\{\{table ([\w.]+) \| (.*?)(?: \| rows (.*?))?\}\}")
_VALUE = re.compile(r"\{\{([\w.]+) \| (.*?) \| (.*?)(?: \| (\.\d+f))?\}\}", re.DOTALL)


@cache
def _topic(topic: str) -> dict[str, dict[str, Any]]:
    return load(topic)


def _entry(name: str) -> Table:
    topic, key = name.split(".")
    entry = _topic(topic)[key]
    return Table(entry["columns"], entry["units"], entry["rows"])


def _text(value: float | str | None, unit: str, rounding: str = "") -> str:
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:{rounding or ','}} {unit}".rstrip()


def _rounding(table: Table, column: str) -> str:
    """Choose the format of a column: the decimals of its finest number, and a sign if needed."""
    # In a column of values, each row has its own quantity.
    if column == "value":
        return ","
    cells = [row[table.columns.index(column)] for row in table.rows]
    floats = [cell for cell in cells if isinstance(cell, float)]
    fractions = [repr(number).partition(".")[2] for number in floats]
    decimals = max(map(len, fractions), default=0)
    has_negative = any(isinstance(cell, float | int) and cell < 0 for cell in cells)
    sign = "+" if has_negative else ""
    return f"{sign},.{decimals}f"


def _table(name: str, columns: str, rows: str | None) -> str:
    """Format some columns, renamed, and the rows whose names have one of the beginnings."""
    table = _entry(name)
    headings = []
    formats = []
    for text in columns.split(";"):
        column, _, heading = text.strip().partition(" = ")
        headings.append(heading or column)
        unit = table.units.get(column, "")
        formats.append((table.columns.index(column), unit, _rounding(table, column)))
    starts = tuple(start.strip() for start in rows.split(";")) if rows else ("",)
    lines = [headings, ["---"] * len(headings)]
    for cells in table.rows:
        if names_of(cells)[-1].startswith(starts):
            lines.append([_text(cells[k], unit, rounding) for k, unit, rounding in formats])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _index() -> str:
    lines = []
    for topic in TOPICS:
        dates = sorted({entry["date"] for entry in _topic(topic).values()})
        span = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
        lines.append(f"- `{topic}.json`, {span}: {', '.join(_topic(topic))}")
    return "\n".join(lines)


def render(template: str) -> str:
    """Fill in a template's placeholders."""
    text = _TABLE.sub(lambda match: _table(match[1], match[2], match[3]), template)
    return _VALUE.sub(_value, text).replace("{{index}}", _index())


def _value(placeholder: re.Match[str]) -> str:
    # Placeholders in wrapped text can have line breaks.
    parts = [" ".join((part or "").split()) for part in placeholder.groups()]
    name, row, column, rounding = parts
    table = _entry(name)
    unit = table.units.get(column, "")
    return _text(table.value(row, column), unit, rounding or _rounding(table, column))


def page() -> str:
    """Make the page."""
    return render((FOLDER / "page.md").read_text(encoding="utf-8"))


def documents() -> dict[str, str]:
    """Make the page and its figure, by the names of their files."""
    return {"README.md": page(), "calibration.svg": calibration_figure(_topic("scale"))}


def quotes() -> dict[str, list[str]]:
    """Fill in the quotes of each document."""
    text = (FOLDER / "quotes.json").read_text(encoding="utf-8")
    templates: dict[str, list[str]] = json.loads(text)
    return {document: [render(quote) for quote in listed] for document, listed in templates.items()}


def missing_quotes() -> list[str]:
    """List the quotes that are missing or have other numbers in their documents."""
    missing = []
    for document, listed in quotes().items():
        text = " ".join((ROOT / document).read_text(encoding="utf-8").split())
        missing += [f"{document}: {quote}" for quote in listed if quote not in text]
    return missing


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page, or check that it is current."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="write nothing; exit status 1 if the page is not current",
    )
    check = parser.parse_args(arguments).check
    stale = False
    for name, content in documents().items():
        target = FOLDER / name
        if target.exists() and target.read_text(encoding="utf-8") == content:
            continue
        stale = True
        if not check:
            target.write_text(content, encoding="utf-8")
    missing = missing_quotes()
    for quote in missing:
        print(f"not quoted as measured: {quote}", file=sys.stderr)
    return 1 if missing or (check and stale) else 0


if __name__ == "__main__":
    sys.exit(main())
