"""One field of an option group: how the command line names it, and what numbers it takes.

Numbers are checked at the door: any real number that is no bool will do, numpy's too, and comes out as Python's. What
has no meaning is an ``InvalidParameterError`` that names the field.
"""

from __future__ import annotations

import math
import numbers
from typing import Any, NamedTuple

from vehanchor.errors import InvalidParameterError


class Choice(NamedTuple):
    """How the command line names and explains a field.

    Attributes:
        help: one sentence, for ``--help``.
        metavar: what stands for the value.
        flag: the option's name; empty for the field's own name without its unit.
    """

    help: str
    metavar: str = ""
    flag: str = ""


def choice(help_text: str, *, metavar: str = "", flag: str = "") -> dict[str, Choice]:
    """Metadata of a dataclass field that the command line offers, too."""
    return {"choice": Choice(help_text, metavar, flag)}


def set_frozen(group: Any, name: str, value: Any) -> None:
    """Set a field of a frozen group while it is being made."""
    object.__setattr__(group, name, value)


def number(name: str, value: Any) -> float:
    """Take any finite real number that is no bool."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
        raise InvalidParameterError(f"{name} is {value!r}: use a finite number")
    return float(value)


def positive(name: str, value: Any) -> float:
    """Take a number above zero."""
    found = number(name, value)
    if found <= 0:
        raise InvalidParameterError(f"{name} is {found:g}: use a finite number > 0")
    return found


def share(name: str, value: Any) -> float:
    """Take a number within 0..1."""
    found = number(name, value)
    if not 0 <= found <= 1:
        raise InvalidParameterError(f"{name} is {found:g}: it lies in 0..1")
    return found


def whole(name: str, value: Any) -> int:
    """Take a whole number of at least one."""
    found = number(name, value)
    if found < 1 or found != int(found):
        raise InvalidParameterError(f"{name} is {found:g}: use a whole number >= 1")
    return int(found)
