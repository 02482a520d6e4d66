"""``vehanchor evaluate area``: the error of measured areas."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import work_progress
from vehanchor_evaluation.commands.request import measuring_command
from vehanchor_evaluation.commands.sources import WorkersOption, open_shared, print_issues

if TYPE_CHECKING:
    from vehanchor.cli.cli_options import ParsedOptions


@dataclass(frozen=True, kw_only=True)
class AreaRequest:
    """Options of the command, one per field."""

    segments: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder with index.csv (image,mask,category,gsd_m_per_px) and numbered 16-bit "
            "masks.",
        ),
    ]
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder of the results; an interrupted run resumes there."
        ),
    ]
    split: Annotated[
        str | None, typer.Option(metavar="NAME", help="Use only this split of the index.")
    ] = None
    limit: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Measure only the first N objects; categories alternate."
        ),
    ] = None
    workers: WorkersOption = None
    segmenter: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="ENCODER DECODER",
            help="ONNX files of a promptable segmenter. Default: the bundled one.",
        ),
    ] = None


@measuring_command(AreaRequest)
def area(request: AreaRequest, parsed: ParsedOptions) -> None:
    """Measure the error of areas on objects with true masks: the paper's Table II.

    Separates the errors of masks and of scales.

    Writes area.csv (each object), area.json and area.md (the table), and area_left_out.csv.
    """
    from vehanchor_evaluation.area_report import area_markdown, write_area_report
    from vehanchor_evaluation.area_run import measure_areas
    from vehanchor_evaluation.areas import read_areas
    from vehanchor_evaluation.search import default_workers

    workers = request.workers or default_workers()
    engine = open_shared(parsed, workers, request.segmenter)
    with work_progress("objects") as show_progress:
        data = read_areas(
            request.segments,
            request.split,
            workers=workers,
            progress=partial(show_progress, name="reading masks"),
        )
        run = measure_areas(
            data,
            engine,
            logs=request.out,
            limit=request.limit,
            workers=workers,
            progress=lambda step: partial(show_progress, name=step),
        )
    print_issues(run.issues)
    write_area_report(request.out, "area", report=run.report, records=run.trials, issues=run.issues)
    print(area_markdown(run.report), end="")
