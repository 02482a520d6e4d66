"""``vehanchor evaluate gsd | ablation | figures | area | vlm``, for the command line to mount."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.options import (
    CalibrationOption,
    ClassOption,
    DetectorOption,
    MinScoreOption,
    ReferenceLengthOption,
    RegionOption,
)
from vehanchor.cli.terminal import printable, told_errors
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor_evaluation.commands.area import area
from vehanchor_evaluation.commands.sources import (
    CacheOption,
    DotaOption,
    FilesCommand,
    GeotiffOption,
    LabelClassOption,
    LabelsOption,
    LimitOption,
    SetOption,
    SplitOption,
    TableOption,
    WorkersOption,
    search,
    survey,
    tell_issues,
)
from vehanchor_evaluation.commands.vlm import vlm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.estimate import ScaleOptions
    from vehanchor_evaluation.gsd import ScaleBenchmark
    from vehanchor_evaluation.known_scale import KnownScaleImage

__all__ = ["evaluate"]

_OUT = Path("vehanchor-evaluation")
_CACHE_NAME = "detections.jsonl"

evaluate = typer.Typer(
    help="Accuracy on images whose truth is known: the paper's tables and figures, on data of yours.",
    no_args_is_help=True,
)


@dataclass(frozen=True)
class ScaleRequest:
    """What all commands on images of known scale are asked: each field is an option."""

    dota: DotaOption = None
    table: TableOption = None
    geotiff: GeotiffOption = None
    labels: LabelsOption = None
    label_classes: LabelClassOption = None
    set_name: SetOption = None
    split: SplitOption = None
    limit: LimitOption = None
    detector: DetectorOption = None
    classes: ClassOption = None
    min_score: MinScoreOption = None
    reference_length: ReferenceLengthOption = None
    label_reference_length: Annotated[
        float | None, typer.Option(metavar="M", help="The same for labelled vehicles. Default: as the detector's.")
    ] = None
    region: RegionOption = None
    set_region: Annotated[
        list[str] | None,
        typer.Option(metavar="SET=REGION", help="The region of one set of the table; may be repeated."),
    ] = None
    calibration: CalibrationOption = None
    workers: WorkersOption = None
    cache: CacheOption = None
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results, made where there is none.")] = _OUT

    def benchmark(self) -> ScaleBenchmark:
        """Survey the data, search the images, make trials of them; what is wrong with which file goes to stderr."""
        from vehanchor.estimate import ScaleOptions
        from vehanchor.scale.calibration import opened_calibration
        from vehanchor_evaluation.dota import SMALL_VEHICLE
        from vehanchor_evaluation.gsd import benchmark_scale

        options = ScaleOptions(
            min_score=self.min_score,
            reference_length_m=self.reference_length,
            region=self.region,
            calibration=opened_calibration(self.calibration),
        )
        options_of = self._options_of(options)
        data = survey(
            self.dota,
            self.table,
            self.geotiff,
            labels=self.labels,
            set_name=self.set_name,
            split=self.split,
            limit=self.limit,
        )
        detector, found = search(
            data,
            self.detector,
            self.classes,
            [options_of(image) for image in data.images],
            workers=self.workers,
            cache=self.cache or self.out / _CACHE_NAME,
        )
        by_labels = ScaleOptions(reference_length_m=self.label_reference_length)
        benchmark = benchmark_scale(
            data,
            found,
            detector.card,
            options_of,
            label_options_of=None if self.label_reference_length is None else lambda _: by_labels,
            label_classes=self.label_classes or (SMALL_VEHICLE,),
        )
        tell_issues(benchmark.issues)
        return benchmark

    def _options_of(self, options: ScaleOptions) -> Callable[[KnownScaleImage], ScaleOptions]:
        """The options of one image: those of all, or with the region of its set."""
        regions = {}
        for text in self.set_region or ():
            name, equals, region = text.partition("=")
            if not equals or not region:
                raise InvalidParameterError(f"--set-region is {text!r}: use SET=REGION, as in cannes=europe")
            regions[name] = replace(options, region=region)
        return lambda image: regions.get(image.set, options)


def _on_known_scale(command: Callable[[ScaleRequest], Sequence[Path]]) -> Callable[..., None]:
    """A command with the fields of ``ScaleRequest`` as its options, which tells what it wrote."""

    def run(**choices: object) -> None:
        with told_errors():
            request = ScaleRequest(**choices)  # type: ignore[arg-type]
            for path in command(request):
                print(printable(f"wrote {path}"), file=sys.stderr)

    run.__doc__ = command.__doc__
    run.__signature__ = inspect.signature(ScaleRequest, eval_str=True)  # type: ignore[attr-defined]
    return run


@evaluate.command("gsd", cls=FilesCommand)
@_on_known_scale
def evaluate_gsd(request: ScaleRequest) -> list[Path]:
    """Error of the estimated scale on images of known scale: the paper's Table I.

    Writes gsd.json, gsd.csv and gsd.md; images.csv, a line an image; issues.csv, what was wrong with which file. Run
    again, the same command goes on where it was interrupted.
    """
    from vehanchor_evaluation.gsd import report_scale
    from vehanchor_evaluation.report import scale_markdown, write_issues, write_results, write_trials

    benchmark = request.benchmark()
    report = report_scale(benchmark)
    text = scale_markdown(report)
    print(printable(text))
    return [
        *write_results(request.out, "gsd", report, [row.model_dump() for row in report.rows], text),
        write_trials(request.out / "images.csv", benchmark),
        write_issues(request.out / "issues.csv", benchmark.issues),
    ]


@evaluate.command("ablation", cls=FilesCommand)
@_on_known_scale
def evaluate_ablation(request: ScaleRequest) -> list[Path]:
    """Change one choice of the method at a time: the paper's Table III, from the same search as 'evaluate gsd'.

    Writes ablation.json, ablation.csv and ablation.md.
    """
    from vehanchor_evaluation.ablation import ablate
    from vehanchor_evaluation.report import ablation_markdown, write_results

    report = ablate(request.benchmark())
    text = ablation_markdown(report)
    print(printable(text))
    rows = [
        {
            "choice": row.choice,
            "setting": row.setting,
            "boxes": row.boxes,
            **row.errors.model_dump(exclude={"name"}),
            "paper_median": row.paper_median,
            "paper_within_20": row.paper_within_20,
        }
        for row in report.rows
    ]
    return write_results(request.out, "ablation", report, rows, text)


@evaluate.command("figures", cls=FilesCommand)
@_on_known_scale
def evaluate_figures(request: ScaleRequest) -> list[Path]:
    """Draw the figures, from the same search as 'evaluate gsd'; extra 'plots'.

    Writes predicted.png (true against predicted scale, the 10 % band, the guard), cumulative.png, calibration.png (of
    interval and confidence) and sheet.png (the best, middle and worst images with their vehicles).
    """
    from vehanchor.pictures.plot import require_plots, write_plot
    from vehanchor.pictures.scale import write_picture
    from vehanchor_evaluation import figures

    require_plots()  # before the search
    benchmark = request.benchmark()
    trials = benchmark.trials
    if not any(trial.estimated for trial in trials):
        raise InvalidParameterError("no image has an estimate: there is nothing to draw")
    curves = {"detector": trials, "labels": benchmark.baseline} if benchmark.baseline else {"detector": trials}
    rows = [[figures.sheet_cell(trial) for trial in row] for row in figures.sheet_trials(trials).values()]
    try:
        request.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {str(request.out)!r}: {error.strerror or error}") from error
    return [
        write_plot(request.out / "predicted.png", figures.plot_predicted(trials)),
        write_plot(request.out / "cumulative.png", figures.plot_cumulative_error(curves)),
        write_plot(request.out / "calibration.png", figures.plot_calibration(trials)),
        write_picture(request.out / "sheet.png", figures.draw_sheet(rows)),
    ]


# --- Commands of their own modules -----------------------------------------------------------------------------------
evaluate.command()(area)
evaluate.command()(vlm)
