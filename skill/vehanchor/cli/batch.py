"""``vehanchor batch``: scales of many images in a table."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.scale_option import KnownLengthsFile
from vehanchor.cli.terminal import (
    FAILED,
    counts_text,
    print_written,
    printable,
    resumable,
    work_progress,
)
from vehanchor.errors import InvalidParameterError, WorkerDiedError
from vehanchor.records.text import count

if TYPE_CHECKING:
    from vehanchor.batch import BatchSummary


Inputs: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        metavar="INPUTS",
        help="Images, directories (searched recursively), patterns such as 'flight/**/*.jpg'.",
        show_default=False,
    ),
]
Table: TypeAlias = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="FILE", help="Table to write, such as scales.csv."),
]
EngineName: TypeAlias = Annotated[
    str,
    typer.Option(
        metavar="local|ray",
        help="Processes of this machine, or Ray Data (extra 'ray'); the rows are the same.",
    ),
]
ClusterAddress: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT",
        help="Ray cluster: auto, host:6379 or ray://host:10001. Default: start a local one.",
    ),
]
Workers: TypeAlias = Annotated[
    int | None,
    typer.Option(metavar="N", help="Number of parallel models. Default: one per CPU."),
]
Overwrite: TypeAlias = Annotated[
    bool,
    typer.Option("--overwrite", help="Start again; do not resume the rows of an interrupted run."),
]
Details: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--details", help="Write all columns, including those of the search and of each ruler."
    ),
]
OverlayFolder: TypeAlias = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Write each image with vehicles and scale bar to a folder."),
]
TargetsFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        help="Measure the targets of a CSV: photograph,kind,x1,y1,x2,y2,name (box, point or line; "
        "paths relative to the table). The output may also be .geojson.",
    ),
]


@scale_command(without=(*OF_ONE_IMAGE, "threads"))
def batch(
    inputs: Inputs,
    out: Table,
    engine: EngineName = "local",
    address: ClusterAddress = None,
    workers: Workers = None,
    overwrite: Overwrite = False,
    details: Details = False,
    overlays: OverlayFolder = None,
    known_lengths: KnownLengthsFile = None,
    measure: TargetsFile = None,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the scales of many images, and write a table with a row per image, errors included.

    After an interruption, the same command resumes the run. With --measure, the table has one row
    per target.
    """
    started = time.monotonic()
    with work_progress("images") as progress:
        if measure is not None:
            if engine != "local" or workers or known_lengths or details or overlays:
                raise InvalidParameterError(
                    "--measure excludes --engine, --workers, --known-lengths, --details and "
                    "--overlays"
                )
            from vehanchor.cli.batch_targets import measure_table

            measure_table(
                inputs,
                measure,
                output=out,
                engine=chosen.engine(),
                tell=progress,
            )
            return

        from vehanchor.batch import run_batch

        with resumable(out, "rows"):
            summary = run_batch(
                inputs,
                out,
                engine=engine,
                address=address,
                workers=workers,
                detector=chosen.detector,
                classes=chosen.classes,
                options=chosen.options(),
                known_lengths=known_lengths,
                details=details,
                overlays=overlays,
                overwrite=overwrite,
                runtime=chosen.runtime(progress),
                isolated=True,
            )
    _print_summary(summary, time.monotonic() - started)
    if overlays is not None:
        print_written([overlays])
    if summary.statuses.get("error", 0) == summary.n_rows:
        print(
            "no image could be used: the columns error_code and error explain why", file=sys.stderr
        )
        raise typer.Exit(FAILED)
    if any(first.reason == WorkerDiedError.code for _, first in summary.causes):
        raise typer.Exit(FAILED)


def _print_summary(summary: BatchSummary, seconds: float) -> None:
    """Print advice for images without a usable scale, and the numbers of the run."""
    for n_rows, first in summary.causes:
        assert first.advice is not None  # each cause has one
        words = first.advice.why
        # The text of an error contains its remedy.
        if first.advice.helps:
            words += f"; {first.advice.helps}"
        photograph = printable(first.photograph)
        print(f"{n_rows} x {first.reason}, as in {photograph}: {words}", file=sys.stderr)
    table = printable(str(summary.table))
    rows = f"{count(summary.n_rows, 'row')} ({counts_text(summary.statuses)})"
    if summary.n_resumed:
        rows += f", {summary.n_resumed} of them from an earlier run"
    images = count(summary.n_rows - summary.n_resumed, "image")
    print(f"wrote {table}: {rows}; {images} in {seconds:.1f} s", file=sys.stderr)
