"""Parser of the area that a language model states in its last line, ``AREA=<number>``."""

from __future__ import annotations

import re
from typing import Literal, NamedTuple

Problem = Literal["no_area_line", "no_number", "ambiguous_number", "unknown_unit"]

_LINE = re.compile(r"\bAREA[ *_`]*=([^\r\n]*)", re.IGNORECASE)
_NUMBER = re.compile(
    r"(?P<sign>[-+\u2212]?)"
    r"(?P<digits>\d(?:[\d.,'\u2019_]|[ \u00a0\u2009\u202f](?=\d{3}(?!\d)))*|\.\d+)"
    r"(?:\s*(?:[eE]|[x\u00d7*\u00b7]\s*10\s*(?:\^|\*\*))\s*[({]?(?P<exponent>[-+\u2212]?\d+)[)}]?)?"
)
_BEFORE = re.compile(
    r"(?:approximately|approx\.?|about|around|circa|ca\.?|roughly|[~\u2248\u223c<(\[$*_`\"'\s])*", re.IGNORECASE
)
_SUPERSCRIPTS = str.maketrans({"\u00b2": "2", "\u00b3": "3", **{c: str(d) for d, c in enumerate("\u2070\u00b9")}})
_M2 = {
    1.0: r"|m\^?2|m\*\*2|sq\.? ?m|sqm|(?:sq\.?|square) ?met(?:er|re)s?|met(?:er|re)s? ?(?:squared|\^?2)",
    1e6: r"km\^?2|sq\.? ?km|(?:sq\.?|square) ?kilomet(?:er|re)s?",
    1e4: r"ha|hectares?",
    1e-4: r"cm\^?2|sq\.? ?cm|square ?centimet(?:er|re)s?",
    0.09290304: r"ft\^?2|sq\.? ?ft|sqft|(?:sq\.?|square) ?(?:feet|foot)",
    0.83612736: r"yd\^?2|sq\.? ?yd|square ?yards?",
    4046.8564224: r"acres?|ac",
}
_UNITS = [(re.compile(pattern, re.IGNORECASE), factor) for factor, pattern in _M2.items()]


class StatedArea(NamedTuple):
    """Parsed reply: an area in square metres, or the reason why it is missing."""

    area_m2: float | None
    problem: Problem | None = None


def read_area(reply: str) -> StatedArea:
    """Parse the last ``AREA=`` of a reply.

    Numbers may have thousands separators (comma, point, apostrophe, underscore or space between groups of three) and
    exponents (``1.2e3``, ``1.2 x 10^3``). If a number has commas and points, the last of them is the decimal separator.
    A single comma before three digits separates thousands. A number without a unit is in square metres; km2, ha, cm2,
    ft2, yd2 and acres are converted. Other units (pixels, for example), ranges and negative numbers are refused. Words
    before the number and brackets after it are ignored.

    Args:
        reply: the model's full reply.

    Returns:
        The area, or the reason why it is missing.
    """
    lines = _LINE.findall(reply)
    if not lines:
        return StatedArea(None, "no_area_line")
    text = _plain(lines[-1])
    start = _BEFORE.match(text)
    found = _NUMBER.match(text, start.end() if start else 0)
    if found is None or found["sign"] in ("-", "\u2212"):
        return StatedArea(None, "no_number")
    value = _value(found["digits"].rstrip(".,"))
    rest = re.split(r"\u00b1|\+/?-|[(\[]", text[found.end() :])[0].strip(" .,;:*_`\"'>)]$\t")
    if value is None or re.search(r"\d", re.sub(r"\^?2\b", "", rest)):
        return StatedArea(None, "ambiguous_number")
    factor = next((factor for unit, factor in _UNITS if unit.fullmatch(rest)), None)
    if factor is None:
        return StatedArea(None, "unknown_unit")
    exponent = int((found["exponent"] or "0").replace("\u2212", "-"))
    if abs(exponent) > 30:
        return StatedArea(None, "ambiguous_number")
    return StatedArea(value * 10.0**exponent * factor)


def _plain(text: str) -> str:
    """Replace LaTeX and superscripts by plain text."""
    text = re.sub(r"\\times|\\cdot", "x", text)
    text = re.sub(r"\\(?:text|mathrm|mathbf|boxed|approx|sim|[,;:! ])|[{}$]", " ", text)
    text = re.sub(r"10([\u2070\u00b9\u00b2\u00b3\u2074-\u2079]+)", lambda m: "10^" + _digits(m[1]), text)
    text = re.sub(r"\s*\^\s*", "^", text.translate(_SUPERSCRIPTS))
    return re.sub(r"[ \t]+", " ", text).strip()


def _digits(superscripts: str) -> str:
    return "".join(str("\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079".index(c)) for c in superscripts)


def _value(digits: str) -> float | None:
    """Parse digits and separators; None if they are ambiguous."""
    text = re.sub(r"['\u2019_ \u00a0\u2009\u202f]", "", digits)
    points, commas = text.count("."), text.count(",")
    if points and commas:
        decimal = max(".", ",", key=text.rfind)
        grouped = "," if decimal == "." else "."
        if text.count(decimal) > 1 or not re.fullmatch(
            rf"\d{{1,3}}(?:{re.escape(grouped)}\d{{3}})+", text[: text.rfind(decimal)]
        ):
            return None
        text = text.replace(grouped, "").replace(decimal, ".")
    elif commas or points > 1:
        separator = "," if commas else "."
        if re.fullmatch(rf"\d{{1,3}}(?:{re.escape(separator)}\d{{3}})+", text):
            text = text.replace(separator, "")
        elif commas == 1:
            text = text.replace(",", ".")
        else:
            return None
    try:
        return float(text)
    except ValueError:
        return None
