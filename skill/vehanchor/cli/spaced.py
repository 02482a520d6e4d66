"""Options that take several numbers each time and may be repeated, which Typer has none of."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand

_VALUES = {"--known-length": 5, "--point": 2, "--negative": 2}


class SpacedCommand(TyperCommand):
    """A command that joins the values of such an option to one text before the rest is parsed."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join, then parse."""
        joined: list[str] = []
        rest = list(args)
        while rest:
            joined.append(rest.pop(0))
            n_values = _VALUES.get(joined[-1], 0)
            apart = bool(rest) and len(rest[0].replace(",", " ").split()) < n_values
            if apart:
                joined.append(" ".join(rest[:n_values]))
                del rest[:n_values]
        return super().parse_args(ctx, joined)
