"""Lone surrogates in JSON: halves of characters, which are no text, and which the SDK refuses.

A model that cuts an emoji in half writes one. The SDK then cannot read the message, and neither
answers it nor knows its id. In its place stands the replacement character, so that the message is
answered as any other.
"""

from __future__ import annotations

import re

_ESCAPE = re.compile(
    r"\\(?:u[dD][89abAB][0-9a-fA-F]{2}\\u[dD][c-fC-F][0-9a-fA-F]{2}|u[dD][89a-fA-F][0-9a-fA-F]{2}|.)"
)
"""An escape of JSON: a pair of surrogates, a lone one, or any other."""

_LONE_CHARS = 6
_REPLACEMENT = "\\ufffd"


def without_lone_surrogates(json_text: str) -> str:
    """Replace the escapes of lone surrogates in a JSON text."""
    if "\\ud" not in json_text and "\\uD" not in json_text:
        return json_text
    return _ESCAPE.sub(_replaced, json_text)


def _replaced(escape: re.Match[str]) -> str:
    text = escape[0]
    is_lone = len(text) == _LONE_CHARS
    return _REPLACEMENT if is_lone else text
