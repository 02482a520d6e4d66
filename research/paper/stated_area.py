"""Parser of the area that a language model states in its last line, ``AREA=<number>``."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Problem = Literal["no_area_line", "no_number", "unknown_unit"]

_LINE = re.compile(r"\bAREA[ *_`]*=([^\r\n]*)", re.IGNORECASE)
_MARKUP = re.compile(r"[*_`$]|\\(?:boxed|text|mathrm)|[{}]")
_STATED = re.compile(
    r"\s*(?:about|approximately|approx\.?|~|\u2248)?\s*"
    r"(?P<number>\d{1,3}(?:,\d{3})+(?:\.\d+)?|\d+(?:\.\d+)?(?:e[+-]?\d{1,2})?)(?![\d.,])"
    r"\s*(?P<unit>[^(\u00b1]*)",
    re.IGNORECASE,
)
_SQUARE_METRES = re.compile(
    r"m\^?2|m\u00b2|sq\.? ?m|(?:sq\.?|square) met(?:er|re)s?|met(?:er|re)s? squared", re.IGNORECASE
)


class StatedArea(NamedTuple):
    """Parsed reply: an area in square metres, or the reason why it is missing."""

    area_m2: float | None
    problem: Problem | None = None


def read_area(reply: str) -> StatedArea:
    """Parse the last ``AREA=`` of a reply.

    The question asks for a number of square metres. Commas may separate thousands, square metres
    may be named, and brackets or a tolerance may follow. Ranges, products and other units are
    refused.

    Args:
        reply: the model's full reply.

    Returns:
        The area, or the reason why it is missing.
    """
    lines = _LINE.findall(reply)
    if not lines:
        return StatedArea(None, "no_area_line")
    match = _STATED.match(_MARKUP.sub("", lines[-1]))
    if match is None:
        return StatedArea(None, "no_number")
    unit = match["unit"].strip(" .,;:\t")
    if unit and not _SQUARE_METRES.fullmatch(unit):
        return StatedArea(None, "unknown_unit")
    return StatedArea(float(match["number"].replace(",", "")))
