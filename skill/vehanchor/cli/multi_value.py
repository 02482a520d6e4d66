"""Repeatable options with several numbers each, which Typer does not support."""

from __future__ import annotations

from typing import Any, get_args

from typer.core import TyperCommand

from vehanchor.errors import PromptError
from vehanchor.options import Basis

# Number of values by option.
_N_VALUES = {"--known-length": 5, "--add": 4, "--point": 2, "--negative": 2}
_FORMER_NAMES = {"--output": "--out"}
"""Former spellings of options."""
# Words that may follow as a further value.
_LAST_WORDS = {"--known-length": get_args(Basis)}


def parse_point(option: str, text: str) -> tuple[float, float]:
    """Read a point, X Y.

    Raises:
        PromptError: the text is not two numbers.
    """
    try:
        numbers = [float(part) for part in text.split()]
        x, y = numbers
    except ValueError:
        raise PromptError(f"{option} is {text!r}: use two numbers, X Y") from None
    return x, y


class SpacedCommand(TyperCommand):
    """Command that joins the values of such an option to one text before Typer parses them."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the values of these options, then parse."""
        joined: list[str] = []
        rest = list(args)
        while rest:
            option = _current_name(rest.pop(0))
            joined.append(option)
            n_values = _separate_values(option, rest)
            if n_values:
                joined.append(" ".join(rest[:n_values]))
                del rest[:n_values]
        return super().parse_args(ctx, joined)


def _current_name(argument: str) -> str:
    """Replace the former spelling of an option; its value may follow after ``=``."""
    name, equals, value = argument.partition("=")
    return f"{_FORMER_NAMES.get(name, name)}{equals}{value}"


def _separate_values(option: str, rest: list[str]) -> int:
    """Count the arguments that are values of an option; 0 if one text holds all values."""
    n_values = _N_VALUES.get(option, 0)
    if not rest:
        return 0
    first_text = rest[0].replace(",", " ")
    if len(first_text.split()) >= n_values:
        return 0
    last_words = _LAST_WORDS.get(option, ())
    if len(rest) > n_values and rest[n_values] in last_words:
        return n_values + 1
    return n_values
