"""Generate the page of results from the data files: ``python -m research.results.page [--check]``.

``page.md`` is the template and ``README.md`` the page. ``quotes.json`` lists what other documents
quote. Placeholders:

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
    """The format of a column: the decimals of its finest number, and a sign where numbers are negative."""
    if column == "value":  # each row has a quantity of its own
        return ","
    numbers = [cells[table.columns.index(column)] for cells in table.rows]
    floats = [number for number in numbers if isinstance(number, float)]
    decimals = max((len(repr(number).partition(".")[2]) for number in floats), default=0)
    sign = "+" if any(isinstance(number, float | int) and number < 0 for number in numbers) else ""
    return f"{sign},.{decimals}f"


def _table(name: str, columns: str, rows: str | None) -> str:
    table = _entry(name)
    chosen = [column.strip().partition(" = ") for column in columns.split(";")]
    formats = [
        (table.columns.index(c), table.units.get(c, ""), _rounding(table, c)) for c, _, _ in chosen
    ]
    starts = tuple(start.strip() for start in rows.split(";")) if rows else ("",)
    lines = [[shown or column for column, _, shown in chosen], ["---" for _ in chosen]]
    for cells in table.rows:
        if names_of(cells)[-1].startswith(starts):
            lines.append([_text(cells[place], unit, rounding) for place, unit, rounding in formats])
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
    text = _TABLE.sub(lambda found: _table(found[1], found[2], found[3]), template)
    return _VALUE.sub(_value, text).replace("{{index}}", _index())


def _value(found: re.Match[str]) -> str:
    name, row, column, rounding = (" ".join((part or "").split()) for part in found.groups())
    table = _entry(name)
    return _text(
        table.value(row, column), table.units.get(column, ""), rounding or _rounding(table, column)
    )


def page() -> str:
    """Make the page."""
    return render((FOLDER / "page.md").read_text(encoding="utf-8"))


def quotes() -> dict[str, list[str]]:
    """Fill in the quotes of each document."""
    found: dict[str, list[str]] = json.loads((FOLDER / "quotes.json").read_text(encoding="utf-8"))
    return {document: [render(quote) for quote in listed] for document, listed in found.items()}


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
    target = FOLDER / "README.md"
    stale = not target.exists() or target.read_text(encoding="utf-8") != page()
    if stale and not check:
        target.write_text(page(), encoding="utf-8")
    missing = missing_quotes()
    for each in missing:
        print(f"not quoted as measured: {each}", file=sys.stderr)
    return 1 if missing or (check and stale) else 0


if __name__ == "__main__":
    sys.exit(main())
