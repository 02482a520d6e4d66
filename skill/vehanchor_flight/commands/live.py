"""``vehanchor flight live``: scale of a running camera, one JSON line a frame."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated

import typer

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.terminal import exit_on_error, printable
from vehanchor.options.models import Precision


@scale_command(
    without=(
        *OF_ONE_IMAGE,
        *("rulers", "height_m", "focal_35mm", "metadata", "precision"),
    )
)
def live(
    folder: Annotated[
        str,
        typer.Argument(metavar="FOLDER", help="A folder into which a program writes frames.", show_default=False),
    ],
    hold: Annotated[float, typer.Option(metavar="S", help="Seconds without vehicles until there is no scale.")] = 10.0,
    idle: Annotated[
        float | None,
        typer.Option(metavar="S", help="End after so many seconds without a new frame. Default: never."),
    ] = None,
    precision: Annotated[
        Precision,
        typer.Option(help="Number format of the detector. Default: int8 where the processor is fast with it."),
    ] = "auto",
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the scale while flying: one JSON line for each frame. Advisory; the newest frame wins."""
    with exit_on_error():
        from vehanchor_flight.verbs import live_scales

        engine = replace(chosen, typed={**chosen.typed, "precision": precision}).engine()
        records = live_scales(folder, engine=engine, hold_s=hold, idle_s=idle, tell=_tell)
        for record in records:
            print(record.model_dump_json(), flush=True)


def _tell(sentence: str) -> None:
    """Print a sentence on stderr."""
    print(printable(sentence), file=sys.stderr, flush=True)
