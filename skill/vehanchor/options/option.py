"""Declaration of an option: help and valid values, declared once.

A field of an option group has its ``Option`` as metadata. Keywords, command-line options, tool arguments and server
settings derive help, type, limits and default from it.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple

from vehanchor.errors import InvalidParameterError

_METADATA = "option"


class Limits(NamedTuple):
    """Valid numbers of an option.

    Attributes:
        least: the smallest number; None for no such limit.
        most: the largest number; None for no such limit.
        above: exclusive lower limit; None for no such limit.
        whole: whether only whole numbers are valid.
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    whole: bool = False

    @property
    def schema(self) -> dict[str, float]:
        """Limits by pydantic's names ``ge``, ``le`` and ``gt``."""
        named = {"ge": self.least, "le": self.most, "gt": self.above}
        return {
            name: int(limit) if limit == int(limit) else limit for name, limit in named.items() if limit is not None
        }

    def __str__(self) -> str:
        """Describe the values, as ``a finite number > 0``."""
        noun = "a whole number" if self.whole else "a finite number"
        if self.least is not None and self.most is not None:
            return f"{noun} from {self.least:.10g} to {self.most:.10g}"
        named = ((" > ", self.above), (" >= ", self.least), (", at most ", self.most))
        return noun + "".join(f"{sign}{limit:.10g}" for sign, limit in named if limit is not None)

    def check(self, name: str, value: Any) -> float:
        """Check a number and convert it to Python's types, also from NumPy's.

        Raises:
            InvalidParameterError: the value is a bool, is not a finite number, or is outside the limits.
        """
        if isinstance(value, bool) or not isinstance(value, numbers.Real) or not math.isfinite(value):
            raise InvalidParameterError(f"{name} is {value!r}: use {self}")
        found = float(value)
        low = found < self.least if self.least is not None else self.above is not None and found <= self.above
        if low or (self.most is not None and found > self.most) or (self.whole and found != int(found)):
            raise InvalidParameterError(f"{name} is {found:.10g}: use {self}")
        return int(found) if self.whole else found


class Text(NamedTuple):
    """Valid texts of an option.

    Attributes:
        most: the largest number of characters.
    """

    most: int = 64

    @property
    def schema(self) -> dict[str, float]:
        """Limit by pydantic's name."""
        return {"max_length": self.most}

    def check(self, name: str, value: Any) -> str:
        """Check a text.

        Raises:
            InvalidParameterError: the value is not a text, or is too long.
        """
        if not isinstance(value, str):
            raise InvalidParameterError(f"{name} is {value!r}: give one name")
        if len(value) > self.most:
            raise InvalidParameterError(f"{name} has {len(value)} characters: use at most {self.most}")
        return value


class Words(NamedTuple):
    """Valid words of an option."""

    words: tuple[str, ...]

    @property
    def schema(self) -> dict[str, float]:
        """Empty: the type lists the words."""
        return {}

    def check(self, name: str, value: Any) -> str:
        """Check a word.

        Raises:
            InvalidParameterError: the value is none of them.
        """
        if not isinstance(value, str) or value not in self.words:
            raise InvalidParameterError(f"{name} is {value!r}: use one of {', '.join(self.words)}")
        return value


class Flag(NamedTuple):
    """Yes or no."""

    @property
    def schema(self) -> dict[str, float]:
        """Empty: the type is enough."""
        return {}

    def check(self, name: str, value: Any) -> bool:
        """Check that a value is True or False.

        Raises:
            InvalidParameterError: the value is neither.
        """
        if not isinstance(value, bool):
            raise InvalidParameterError(f"{name} is {value!r}: use True or False")
        return value


class Option(NamedTuple):
    """Declaration of an option.

    Attributes:
        help: one or two short sentences for ``--help``, tools and settings.
        takes: valid values; None for an option that its group checks.
        metavar: placeholder of the value on the command line.
        flag: name on the command line; empty for the field's name without its unit.
        keyword: name as a keyword; empty for the field's name.
        cli: whether the command line offers it.
        read: reads the value, or an item of it, from one text of the command line; None for what Typer reads.
        repeated: whether the command line repeats it, once for each item.
        first: whether ``--help`` shows it first, because it needs no knowledge of the method.
    """

    help: str
    takes: Limits | Text | Words | Flag | None = None
    metavar: str = ""
    flag: str = ""
    keyword: str = ""
    cli: bool = True
    read: Callable[[str], Any] | None = None
    repeated: bool = False
    first: bool = False

    def from_texts(self, given: Any) -> Any:
        """Convert what the command line gave: one text, a list of texts, or a value that Typer has read."""
        read = self.read or _unchanged
        if self.repeated:
            return [read(text) for text in given]
        return read(given) if isinstance(given, str) else given


def _unchanged(text: str) -> str:
    return text


def option(help_text: str, takes: Limits | Text | Words | Flag | None = None, **parts: Any) -> dict[str, Option]:
    """Make the metadata of a dataclass field from the parts of an ``Option``."""
    return metadata_of(Option(help_text, takes, **parts))


def metadata_of(declared: Option) -> dict[str, Option]:
    """Make the metadata of a dataclass field from its ``Option``."""
    return {_METADATA: declared}


def option_of(field: Any) -> Option | None:
    """Get the declaration of a dataclass field; None for a field that is not an option."""
    found: Option | None = field.metadata.get(_METADATA)
    return found


def keyword_of(field: Any) -> str:
    """Get the keyword of a field."""
    declared = option_of(field)
    name: str = field.name
    return declared.keyword or name if declared is not None else name


def set_frozen(group: Any, name: str, value: Any) -> None:
    """Set a field of a frozen group in its ``__post_init__``."""
    object.__setattr__(group, name, value)


def check_fields(group: Any) -> None:
    """Check the fields of a group by their declarations; None is valid if the field's type has it.

    Raises:
        InvalidParameterError: a value is invalid.
    """
    for each in fields(group):
        declared, value = option_of(each), getattr(group, each.name)
        if declared is None or declared.takes is None or (value is None and str(each.type).endswith("| None")):
            continue
        set_frozen(group, each.name, declared.takes.check(keyword_of(each), value))
