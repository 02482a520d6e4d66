"""Commands ``vehanchor evaluate gsd | reliability | ...``: accuracy on data of known truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import print_written, printable
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor_evaluation.commands.area import area
from vehanchor_evaluation.commands.request import measuring_command
from vehanchor_evaluation.commands.sources import (
    FilesCommand,
    KnownScaleRequest,
    open_shared,
    print_issues,
)

if TYPE_CHECKING:
    from vehanchor.cli.cli_options import ParsedOptions
    from vehanchor_evaluation.gsd import ScaleBenchmark

_OUT = Path("vehanchor-evaluation")
_CACHE_NAME = "detections.sqlite"

evaluate = typer.Typer(
    help="Accuracy on images of known truth: the paper's tables and figures on your data.",
    no_args_is_help=True,
)


@dataclass(frozen=True, kw_only=True)
class ScaleRequest(KnownScaleRequest):
    """Options of all commands on images of known scale, one per field."""

    label_reference_length: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Reference length for labelled vehicles, metres. Default: the detector's.",
        ),
    ] = None
    set_region: Annotated[
        list[str] | None,
        typer.Option(metavar="SET=REGION", help="Region of one set of the table; repeatable."),
    ] = None
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder of the results; created if missing.")
    ] = _OUT

    def benchmark(self, parsed: ParsedOptions) -> ScaleBenchmark:
        """Survey the data, search the images and create trials; issues go to stderr."""
        from vehanchor.options import Reference
        from vehanchor.rulers.known_length_table import with_lines_of
        from vehanchor_evaluation.dota import SMALL_VEHICLE
        from vehanchor_evaluation.gsd import benchmark_scale, check_options, with_regions

        options = parsed.options()
        options_of = with_regions(options, self._regions())
        data = self.survey()
        detector = open_shared(parsed, self.workers).detector
        check_options(detector, data, options_of)
        lines = self.lines(image.path for image in data.images)
        cache = self.cache or self.out / _CACHE_NAME
        searched = self.search(data, detector, options, cache=cache)
        label_options_of = options_of
        if self.label_reference_length is not None:
            label_options = replace(options, reference=Reference(self.label_reference_length))
            label_options_of = with_regions(label_options, {})
        benchmark = benchmark_scale(
            data,
            searched,
            detector=detector.card,
            options_of=lambda image: with_lines_of(options_of(image), lines, image.path),
            label_options_of=label_options_of,
            label_classes=self.label_classes or (SMALL_VEHICLE,),
        )
        print_issues(benchmark.issues)
        return benchmark

    def _regions(self) -> dict[str, str]:
        """Parse the regions by set."""
        regions = {}
        for text in self.set_region or ():
            name, equals, region = text.partition("=")
            if not equals or not region:
                raise InvalidParameterError(
                    f"--set-region is {text!r}: use SET=REGION, as in cannes=europe"
                )
            regions[name] = region
        return regions


@evaluate.command("gsd", cls=FilesCommand)
@measuring_command(ScaleRequest)
def evaluate_gsd(request: ScaleRequest, parsed: ParsedOptions) -> None:
    """Measure the error of the scale on images of known scale: the paper's Table I.

    Writes gsd.json, gsd.csv, gsd.md, images.csv (a line per image) and issues.csv (problems by
    file). After an interruption, the same command resumes.
    """
    from vehanchor_evaluation.gsd import report_scale
    from vehanchor_evaluation.report import (
        scale_markdown,
        write_issues,
        write_results,
        write_trials,
    )

    benchmark = request.benchmark(parsed)
    report = report_scale(benchmark)
    text = scale_markdown(report)
    print(printable(text, lines=True))
    rows = [row.model_dump() for row in report.rows]
    written = write_results(request.out, "gsd", record=report, rows=rows, markdown=text)
    written.append(write_trials(request.out / "images.csv", benchmark))
    issues_file = write_issues(request.out / "issues.csv", benchmark.issues)
    written.append(issues_file)
    print_written(written)


@evaluate.command("reliability", cls=FilesCommand)
@measuring_command(ScaleRequest)
def evaluate_reliability(request: ScaleRequest, parsed: ParsedOptions) -> None:
    """Compare stated chances with outcomes on images of known scale.

    Uses the search of 'evaluate gsd'. Also gives the usable share and the errors by vehicles and by
    resolution, and the confidence from which on 1 % are wrong. Writes reliability.json,
    reliability.csv (a line per group) and reliability.md.
    """
    from vehanchor_evaluation.reliability import report_reliability
    from vehanchor_evaluation.report import reliability_markdown, write_results

    benchmark = request.benchmark(parsed)
    report = report_reliability(benchmark.data.source, benchmark.detector.name, benchmark.trials)
    text = reliability_markdown(report)
    print(printable(text, lines=True))
    groups = {"vehicles": (*report.by_vehicles, report.whole), "true m/px": report.by_resolution}
    rows = [
        {"by": by, **row.model_dump()}
        for by, rows_of_group in groups.items()
        for row in rows_of_group
    ]
    written = write_results(request.out, "reliability", record=report, rows=rows, markdown=text)
    print_written(written)


@evaluate.command("ablation", cls=FilesCommand)
@measuring_command(ScaleRequest)
def evaluate_ablation(request: ScaleRequest, parsed: ParsedOptions) -> None:
    """Change one option of the method at a time: the paper's Table III.

    Uses the search of 'evaluate gsd'. Writes ablation.json, ablation.csv and ablation.md.
    """
    from vehanchor_evaluation.ablation import ablate
    from vehanchor_evaluation.report import ablation_markdown, write_results

    report = ablate(request.benchmark(parsed))
    text = ablation_markdown(report)
    print(printable(text, lines=True))
    rows = [row.flat() for row in report.rows]
    written = write_results(request.out, "ablation", record=report, rows=rows, markdown=text)
    print_written(written)


@evaluate.command("figures", cls=FilesCommand)
@measuring_command(ScaleRequest)
def evaluate_figures(request: ScaleRequest, parsed: ParsedOptions) -> None:
    """Draw the figures from the search of 'evaluate gsd'; needs the extra 'plots'.

    Writes predicted.png (predicted against true GSD, the 10 % band, the resolution guard),
    cumulative.png, calibration.png (interval and confidence) and sheet.png (best, middle and worst
    images with their vehicles).
    """
    from vehanchor.pictures.plot import require_plots, write_plot
    from vehanchor.pictures.scale import write_picture
    from vehanchor_evaluation import figures

    # A missing matplotlib is reported before the search, which can take hours.
    require_plots()
    benchmark = request.benchmark(parsed)
    trials = benchmark.trials
    if not any(trial.estimated for trial in trials):
        raise InvalidParameterError("no image has an estimate, so there is nothing to draw")
    curves = {"detector": trials}
    if benchmark.baseline:
        curves["labels"] = benchmark.baseline
    rows = [
        [figures.sheet_cell(trial) for trial in row]
        for row in figures.sheet_trials(trials).values()
    ]
    out = request.out
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot create the folder {str(out)!r}: {error.strerror or error}"
        ) from error
    written = [
        write_plot(out / "predicted.png", figures.plot_predicted(trials)),
        write_plot(out / "cumulative.png", figures.plot_cumulative_error(curves)),
        write_plot(out / "calibration.png", figures.plot_calibration(trials)),
        write_picture(out / "sheet.png", figures.draw_sheet(rows)),
    ]
    print_written(written)


evaluate.command("area")(area)
