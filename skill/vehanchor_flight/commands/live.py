"""``vehanchor flight live``: scale of a running camera, one line of JSON for each frame."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.terminal import printable


@scale_command(
    without=(
        *OF_ONE_IMAGE,
        "rulers",
        "height_m",
        "height_basis",
        "height_tolerance_m",
        "focal_35mm",
        "metadata",
    )
)
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="A folder that fills, a video, or the number of a camera (0 is the first).",
            show_default=False,
        ),
    ],
    every: Annotated[
        float, typer.Option(metavar="S", help="For a video: seconds between frames.")
    ] = 0.2,
    hold: Annotated[
        float, typer.Option(metavar="S", help="Seconds without vehicles until there is no scale.")
    ] = 10.0,
    idle: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="End after this many seconds without a new frame. Default: never."
        ),
    ] = None,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate an advisory scale while flying: one JSON line for each frame; the newest wins."""
    from vehanchor_flight.verbs import live_scales

    records = live_scales(
        source,
        engine=chosen.engine(),
        every_s=every,
        hold_s=hold,
        idle_s=idle,
        tell=_print_on_stderr,
    )
    for record in records:
        print(record.model_dump_json(), flush=True)


def _print_on_stderr(sentence: str) -> None:
    print(printable(sentence), file=sys.stderr, flush=True)
