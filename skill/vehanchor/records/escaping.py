"""Text that others wrote (file names, metadata) as readers can take it without harm; HTML has ``html.escape``."""

from __future__ import annotations

from typing import Any

_FORMULA = ("=", "+", "-", "@", "\t", "\r")


def on_one_line(text: str) -> str:
    """Escape what would start a line, move the cursor or reverse the text, for models, terminals and logs.

    Escaped are control characters, line and paragraph separators, marks of direction, and bytes
    that are not UTF-8.
    """
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode("ascii")
        for each in text
    )


def in_cell(value: Any) -> Any:
    """Put an apostrophe before a text that a spreadsheet would run as a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
