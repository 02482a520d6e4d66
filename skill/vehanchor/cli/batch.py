"""``vehanchor batch``: scales of many images in a table."""

from __future__ import annotations

import sys
import time
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.given_scale import KnownLengthsFile
from vehanchor.cli.terminal import FAILED, INTERRUPTED, exit_on_error, image_progress, printable
from vehanchor.errors import InvalidParameterError
from vehanchor.options.by_hand import BY_HAND

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor.batch import BatchSummary

_STATUSES = ("ok", "low_confidence", "no_scale", "error")


TargetsFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        help="Measure the targets of a CSV: file,kind,x1,y1,x2,y2,name (box, point or line; files relative to the "
        "table). The output may also be .geojson or .gpkg.",
    ),
]


class _Engine(StrEnum):
    local = "local"
    ray = "ray"


@scale_command(without=("frame", "coordinates", "known_lengths", *BY_HAND, "threads"))
def batch(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUTS",
            help="Images, directories (searched recursively), patterns such as 'flight/**/*.jpg', or addresses.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="File to write: .parquet, .csv or .jsonl.")
    ],
    engine: Annotated[
        _Engine, typer.Option(help="local: processes of this machine; ray: Ray Data (extra 'ray'). Same rows.")
    ] = _Engine.local,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="Ray cluster: 'auto', host:6379, ray://host:10001. Default: a local one."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Number of parallel models. Default: one per CPU.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Start again and replace results of an earlier run.")
    ] = False,
    known_lengths: KnownLengthsFile = None,
    measure: TargetsFile = None,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the scales of many images, and write a table with one row per image, errors included.

    After an interruption, the same command resumes the run. With --measure, the table has one row per target.
    """
    with exit_on_error():
        started = time.monotonic()
        with image_progress() as progress:
            if measure is not None:
                if engine is not _Engine.local or workers or known_lengths:
                    raise InvalidParameterError("--measure excludes --engine, --workers and --known-lengths")
                from vehanchor.cli.batch_targets import measure_table

                measure_table(inputs, measure, output, chosen.engine(), progress, overwrite=overwrite)
                return
            try:
                run = partial(_run, inputs, output, chosen, progress, workers, overwrite=overwrite)
                summary = run(engine, address, known_lengths)
            except KeyboardInterrupt:
                print("interrupted: finished rows are kept; run the same command to resume", file=sys.stderr)
                raise typer.Exit(INTERRUPTED) from None
        _summarise(summary, time.monotonic() - started)


def _run(
    inputs: list[str],
    output: Path,
    chosen: ParsedOptions,
    progress: Callable[[int, int], None],
    workers: int | None,
    engine: _Engine,
    address: str | None,
    known_lengths: Path | None,
    *,
    overwrite: bool,
) -> BatchSummary:
    from vehanchor.batch import run_batch

    model = chosen.detector
    return run_batch(
        inputs,
        output,
        engine=engine.value,
        address=address,
        workers=workers,
        detector=model.detector,
        classes=model.names_and_indices,
        options=chosen.options(),
        known_lengths=known_lengths,
        overwrite=overwrite,
        runtime=model.runtime(progress),
    )


def _summarise(summary: BatchSummary, seconds: float) -> None:
    """Print the summary; fail if every image did."""
    print(_summary_text(summary, seconds), file=sys.stderr)
    if summary.statuses.get("error", 0) == summary.n_rows:
        print("no image could be used: the columns error_code and error say why", file=sys.stderr)
        raise typer.Exit(FAILED)


def _summary_text(summary: BatchSummary, seconds: float) -> str:
    counts = [f"{summary.statuses[status]} {status}" for status in _STATUSES if status in summary.statuses]
    made = summary.n_rows - summary.n_resumed
    resumed = f", {summary.n_resumed} of them from an earlier run" if summary.n_resumed else ""
    pace, rate = summary.pace, ""
    if pace is not None:
        waiting = f"{pace.busy:.1f} workers busy, {pace.waiting:.0%} of it waiting for images"
        rate = f", {pace.images_per_s:.3g} a second ({waiting}; bounded by {pace.bounded_by})"
    return (
        f"{printable(str(summary.table))}: {_counted(summary.n_rows, 'row')} ({', '.join(counts)}){resumed}; "
        f"{_counted(made, 'image')} in {seconds:.1f} s{rate}"
    )


def _counted(n: int, noun: str) -> str:
    return f"{n} {noun}{'s' * (n != 1)}"
