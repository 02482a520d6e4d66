"""``vehanchor evaluate area``: the error of measured areas."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import tile_progress
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.request import measuring_command
from vehanchor_evaluation.commands.sources import WorkersOption, open_shared, print_issues

if TYPE_CHECKING:
    from vehanchor.cli.cli_options import ParsedOptions
    from vehanchor_evaluation.rs_gsd import Recipe

_DATA, _CHOICE, _MODELS = "Data: iSAID with DOTA, or masks, or an existing benchmark", "Choice of entries", "Models"


@dataclass(frozen=True, kw_only=True)
class AreaRequest:
    """Options of the command, one per field."""

    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results; an interrupted run resumes there.")]
    isaid: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR", help="iSAID: its instance images or COCO files; repeatable.", rich_help_panel=_DATA
        ),
    ] = None
    dota: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="DOTA's split of the same images, with images/ and labelTxt*/; one for each --isaid.",
            rich_help_panel=_DATA,
        ),
    ] = None
    segments: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="A folder with index.csv and numbered 16-bit masks.", rich_help_panel=_DATA),
    ] = None
    split: Annotated[
        str | None, typer.Option(metavar="NAME", help="Use only this split of the index.", rich_help_panel=_DATA)
    ] = None
    benchmark: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="A benchmark from an earlier run.", rich_help_panel=_DATA),
    ] = None
    entries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Entries; 0 for every object.", rich_help_panel=_CHOICE)
    ] = 100
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the choice.", rich_help_panel=_CHOICE)] = 0
    category: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Category to choose from; repeatable. Default: the benchmark's 8 for iSAID, else all.",
            rich_help_panel=_CHOICE,
        ),
    ] = None
    min_side: Annotated[
        int, typer.Option(min=2, metavar="PX", help="Shortest side of an object's box.", rich_help_panel=_CHOICE)
    ] = 15
    build_only: Annotated[
        bool, typer.Option("--build-only", help="Build the benchmark and measure nothing.", rich_help_panel=_CHOICE)
    ] = False
    limit: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Measure only the first N entries; categories alternate.")
    ] = None
    workers: WorkersOption = None
    segmenter: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="ENCODER DECODER",
            help="ONNX files of a promptable segmenter. Default: the bundled one.",
            rich_help_panel=_MODELS,
        ),
    ] = None

    def recipe(self) -> Recipe:
        """Create the recipe of the benchmark.

        Raises:
            InvalidParameterError: there is not exactly one source of data.
        """
        from vehanchor_evaluation.rs_gsd import CATEGORIES, Recipe

        given = [value for value in (self.isaid, self.segments, self.benchmark) if value]
        if len(given) != 1 or len(self.isaid or ()) != len(self.dota or ()):
            raise InvalidParameterError(
                "give one source of data: --isaid DIR with --dota DIR, or --segments DIR, or --benchmark DIR"
            )
        return Recipe(
            isaid=tuple(str(path.resolve()) for path in self.isaid or ()),
            dota=tuple(str(path.resolve()) for path in self.dota or ()),
            segments=None if self.segments is None else str(self.segments.resolve()),
            split=self.split,
            entries=self.entries or None,
            seed=self.seed,
            categories=tuple(self.category) if self.category else CATEGORIES if self.isaid else None,
            min_side_px=self.min_side,
        )


@measuring_command(AreaRequest)
def area(request: AreaRequest, chosen: ParsedOptions) -> None:
    """Measure the error of areas on objects with true masks: the paper's Table II, split by source of error.

    Writes area.csv (each entry), area.json and area.md (the table), area_left_out.csv, and the benchmark, which
    'evaluate vlm' uses for language models.
    """
    from vehanchor_evaluation.search import default_workers

    recipe, workers = request.recipe(), request.workers or default_workers()
    folder = request.benchmark or _build(recipe, request.out / "benchmark", workers)
    if request.build_only:
        _print_benchmark(folder)
    else:
        _measure(request, chosen, folder, workers)


def _build(recipe: Recipe, folder: Path, workers: int) -> Path:
    """Build the benchmark if necessary; report issues of its data and write them next to it."""
    from vehanchor_evaluation.report import write_issues
    from vehanchor_evaluation.rs_gsd import open_benchmark

    with tile_progress(1, lines_on_terminal=False) as step:
        issues = open_benchmark(recipe, folder, workers=workers, progress=step(0, "reading masks"))
    if issues:
        print_issues(issues)
        write_issues(folder / "left_out.csv", issues)
    return folder


def _print_benchmark(folder: Path) -> None:
    from collections import Counter

    from vehanchor_evaluation.rs_gsd import load_benchmark

    built = load_benchmark(folder)[0]
    counts = Counter(entry.category for entry in built.entries)
    images = len({entry.image for entry in built.entries})
    print(f"{folder}: {len(built.entries)} entries in {images} images")
    for category, available in built.available.items():
        print(f"  {category}: {counts[category]} of {available}")


def _measure(request: AreaRequest, chosen: ParsedOptions, folder: Path, workers: int) -> None:
    """Measure the benchmark, write the results and print the table."""
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor_evaluation.area_report import area_markdown, write_area_report
    from vehanchor_evaluation.area_run import measure_benchmark

    engine = open_shared(chosen, workers, request.segmenter)
    options = engine.options
    detector, segmenter = checked_detector(engine.detector, options), engine.segmenter
    with tile_progress(1, lines_on_terminal=False) as step:
        run = measure_benchmark(
            folder,
            detector,
            segmenter,
            options,
            logs=request.out,
            classes=chosen.detector.classes,
            limit=request.limit,
            workers=workers,
            progress=lambda what: step(0, what),
        )
    print_issues(run.issues)
    write_area_report(request.out, "area", run.report, run.trials, run.issues)
    print(area_markdown(run.report), end="")
