"""``vehanchor flight``: photographs of one flight, or the sub-commands ``rescale`` and ``live``."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from vehanchor.cli.multi_value import SpacedCommand
from vehanchor_flight.commands.live import live
from vehanchor_flight.commands.photographs import photographs
from vehanchor_flight.commands.rescale import rescale

_DEFAULT = "photographs"
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class _WithDefault(TyperGroup):
    """Group of commands; arguments that begin with none of them belong to ``photographs``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Name the default command, unless another or the help is asked for."""
        if (
            args
            and args[0] not in self.commands
            and not {args[0]} & set(_SETTINGS["help_option_names"])
        ):
            args = [_DEFAULT, *args]
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
    flight.command(_command.__name__, cls=SpacedCommand, context_settings=_SETTINGS)(_command)
