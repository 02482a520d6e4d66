"""Repeatable options of several numbers each, which Typer does not support."""

from __future__ import annotations

from typing import Any, get_args

from typer.core import TyperCommand

from vehanchor.errors import PromptError
from vehanchor.options import Basis

_WORDS = {"--known-length": get_args(Basis)}  # a last value that may follow
_VALUES = {"--known-length": 5, "--add": 4, "--point": 2, "--negative": 2}


def parse_point(option: str, text: str) -> tuple[float, float]:
    """Read a point, X Y.

    Raises:
        PromptError: the text is not two numbers.
    """
    try:
        x, y = (float(part) for part in text.split())
    except ValueError:
        raise PromptError(f"{option} is {text!r}: use two numbers, X Y") from None
    return x, y


class SpacedCommand(TyperCommand):
    """Command that joins the values of such an option to one text before parsing."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join values, then parse."""
        joined: list[str] = []
        rest = list(args)
        while rest:
            joined.append(rest.pop(0))
            n_values = _VALUES.get(joined[-1], 0)
            apart = bool(rest) and len(rest[0].replace(",", " ").split()) < n_values
            if apart:
                n_values += len(rest) > n_values and rest[n_values] in _WORDS.get(joined[-1], ())
                joined.append(" ".join(rest[:n_values]))
                del rest[:n_values]
        return super().parse_args(ctx, joined)
