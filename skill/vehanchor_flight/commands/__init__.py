"""``vehanchor flight``: photographs of one flight, or the sub-commands ``rescale`` and ``live``."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from vehanchor.cli.multi_value import SpacedCommand
from vehanchor_flight.commands.live import live
from vehanchor_flight.commands.photographs import photographs
from vehanchor_flight.commands.rescale import rescale

_DEFAULT_COMMAND = "photographs"
_HELP_OPTIONS = ["-h", "--help"]
_SETTINGS = {"help_option_names": _HELP_OPTIONS}


class _WithDefault(TyperGroup):
    """Group of commands; arguments that begin with none of them belong to ``photographs``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command, unless the arguments begin with a command or ask for help."""
        if args:
            first = args[0]
            if first not in self.commands and first not in _HELP_OPTIONS:
                args = [_DEFAULT_COMMAND, *args]
        return super().parse_args(ctx, args)


flight = typer.Typer(
    cls=_WithDefault,
    help="Scales from more than one photograph. 'vehanchor flight PHOTOS' is 'vehanchor flight "
    "photographs PHOTOS'.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)
for _command in (photographs, rescale, live):
    _register = flight.command(_command.__name__, cls=SpacedCommand, context_settings=_SETTINGS)
    _register(_command)
