"""Escape foreign text, such as file names and metadata, for terminals, models and spreadsheets.

For HTML, use ``html.escape``.
"""

from __future__ import annotations

import json
from typing import Any

# A spreadsheet runs a text as a formula if it starts with one of these.
_FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r")


def on_one_line(text: str) -> str:
    """Escape characters that would start a line, move the cursor or reverse the text.

    These are control characters, line and paragraph separators, direction marks, and bytes that
    are not UTF-8.
    """
    return "".join(
        character if character.isprintable() else _escaped(character) for character in text
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def as_json(value: Any) -> str:
    """Write a value as JSON in ASCII.

    Bytes of a file name that are not UTF-8 are lone surrogates in Python, which no JSON text may
    have: they are escaped, with a backslash.
    """
    return json.dumps(_without_surrogates(value), allow_nan=False)


def _without_surrogates(value: Any) -> Any:
    """Escape the lone surrogates in the texts of a JSON value."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {key: _without_surrogates(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_without_surrogates(inner) for inner in value]
    return value


def in_cell(value: Any) -> Any:
    """Put an apostrophe before a text that a spreadsheet would run as a formula."""
    if isinstance(value, str) and value.startswith(_FORMULA_STARTS):
        return f"'{value}"
    return value
