"""The command line: ``vehanchor estimate | measure | batch | evaluate | calibrate | scene | models | serve | schemas``.

Results go to stdout, everything else (progress, errors, warnings) to stderr. Exit status: 0 with a result, also where
an image has no anchor; 2 for bad input, bad options or an output that cannot be written; 130 after Ctrl-C; 1 for
anything unforeseen.

Whatever is slow to load (OpenCV, ONNX Runtime, tables) is imported by the command that needs it: help comes at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehanchor.cli.batch import batch
from vehanchor.cli.measure import PointsCommand, measure
from vehanchor.cli.options import (
    BandsOption,
    CalibrationOption,
    ClassOption,
    DetectorOption,
    MinScoreOption,
    ProviderOption,
    ReferenceLengthOption,
    RegionOption,
    ThreadsOption,
    open_detector,
)
from vehanchor.cli.terminal import (
    BAD_INPUT,
    INTERRUPTED,
    STATUS_TEXTS,
    UNFORESEEN,
    facts_table,
    failure,
    print_json,
    print_table,
    print_warnings,
    printable,
    report,
    scale_text,
    tile_progress,
    told_errors,
)
from vehanchor.errors import InvalidParameterError, ModelError, OutputError, VehAnchorError
from vehanchor_evaluation.commands.calibrate import calibrate
from vehanchor_evaluation.commands.evaluate import evaluate
from vehanchor_evaluation.commands.sources import FilesCommand
from vehanchor_server.command import schemas, serve

if TYPE_CHECKING:
    from rich.table import Table

    from vehanchor.detection.detector import Detector, DetectorCard
    from vehanchor.estimate import ScaleAnalysis, ScaleOptions
    from vehanchor.records import GsdEstimate
    from vehanchor.scale.calibration import Calibration

__all__ = ["app", "main"]

_STEM = "{stem}"
_SHORT_SHA = 12

app = typer.Typer(
    name="vehanchor",
    help="Metric scale for aerial images without metadata: cars as the ruler.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_models = typer.Typer(help="The models: those that ship with VehAnchor, and files of your own.", no_args_is_help=True)
app.add_typer(_models, name="models")


class _Aggregation(StrEnum):
    kde = "kde"
    weighted_kde = "weighted_kde"
    median = "median"
    mean = "mean"


class _Layout(StrEnum):
    urban = "urban"
    parking = "parking"
    countryside = "countryside"


def main() -> None:
    """Run the command line; the entry point of ``vehanchor`` and of ``python -m vehanchor``."""
    try:
        try:
            app(prog_name="vehanchor")
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains on its way out
        sys.exit(UNFORESEEN)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"vehanchor {version('vehanchor')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version  # its callback has printed it


# --- estimate --------------------------------------------------------------------------------------------------------


@app.command()
def estimate(
    images: Annotated[
        list[str],
        typer.Argument(metavar="IMAGE", help="Photographs: JPEG, PNG, WebP, BMP, TIFF, GeoTIFF.", show_default=False),
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object per image and line on stdout, and nothing else.")
    ] = False,
    overlay: Annotated[
        str | None,
        typer.Option(
            metavar="OUT.png",
            help="Write the image with its vehicles and a scale bar. '{stem}' in the name stands for the image's name "
            "without suffix; with several images it must be there.",
        ),
    ] = None,
    plot: Annotated[
        str | None,
        typer.Option(
            metavar="OUT.png", help="Write the plot of lengths, mode and interval (extra 'plots'). '{stem}' too."
        ),
    ] = None,
    detector: DetectorOption = None,
    classes: ClassOption = None,
    reference_length: ReferenceLengthOption = None,
    region: RegionOption = None,
    calibration: CalibrationOption = None,
    aggregation: Annotated[
        _Aggregation | None,
        typer.Option(
            help="How lengths become one; below 5 vehicles a KDE gives way to the median. Default: the model's choice, "
            "or kde."
        ),
    ] = None,
    alpha: Annotated[
        str, typer.Option(metavar="X|none", help="Drop vehicles longer than X times the median; 'none' keeps all.")
    ] = "1.5",
    min_score: MinScoreOption = None,
    nms_iou: Annotated[
        float, typer.Option("--nms-iou", metavar="P", help="Of two boxes that overlap by more (IoU) one is dropped.")
    ] = 0.45,
    search_scales: Annotated[
        bool | None,
        typer.Option(
            "--search-scales/--no-search-scales",
            help="Search copies at 1/2, 1/4 and 1/8, too, for vehicles longer than the model was trained on. "
            "Default: the model's choice.",
        ),
    ] = None,
    tile: Annotated[
        int | None, typer.Option(metavar="PX", help="Side of a tile, pixels. Default: 1024, or the model's input.")
    ] = None,
    stride: Annotated[
        int | None, typer.Option(metavar="PX", help="Step between tiles, pixels. Default: 3/4 of the tile.")
    ] = None,
    frame: Annotated[
        tuple[int, int] | None,
        typer.Option(
            metavar="W H", help="Size, pixels, of a resized copy that you work in: gives the scale in its pixels, too."
        ),
    ] = None,
    bands: BandsOption = None,
    threads: ThreadsOption = None,
    provider: ProviderOption = None,
) -> None:
    """Estimate the ground sampling distance (metres per pixel) of aerial images from the cars in them."""
    with told_errors():
        try:
            outputs = _outputs(images, overlay, plot)
            options = _scale_options(
                aggregation=aggregation.value if aggregation else None,
                alpha=_alpha(alpha),
                min_score=min_score,
                nms_iou=nms_iou,
                search_scales=search_scales,
                tile_px=tile,
                stride_px=stride,
                reference_length_m=reference_length,
                region=region,
                calibration=_calibration(calibration),
                frame_width_px=frame[0] if frame else None,
                frame_height_px=frame[1] if frame else None,
                bands=bands,
            )
            model = open_detector(detector, classes, threads=threads, providers=provider)
        except VehAnchorError as error:
            if as_json:  # every image gets its line
                for source in images:
                    print_json(failure(source, error))
            raise
        rows: list[tuple[str, GsdEstimate]] = []
        n_failed = 0
        with tile_progress(len(images), lines_on_terminal=as_json and sys.stdout.isatty()) as step:
            for number, source in enumerate(images):
                try:
                    analysis = _analyse(source, options, model, step(number, source))
                except VehAnchorError as error:
                    n_failed += 1
                    report(error, source if len(images) > 1 else "")
                    if as_json:
                        print_json(failure(source, error))
                    continue
                if as_json:
                    print_json({"source": source, **analysis.estimate.model_dump(mode="json")})
                rows.append((source, analysis.estimate))
                try:
                    _write_pictures(source, analysis, options, outputs[number])
                except VehAnchorError as error:
                    n_failed += 1
                    report(error, source if len(images) > 1 else "")
        if rows and not as_json:
            print_table(_summary_table(rows) if len(images) > 1 else _estimate_table(*rows[0]))
            for source, record in rows:
                print_warnings(record, source if len(images) > 1 else "")
        if n_failed:
            raise typer.Exit(BAD_INPUT)


@dataclass(frozen=True)
class _Outputs:
    """The pictures to write of one image."""

    overlay: Path | None
    plot: Path | None


def _outputs(images: Sequence[str], overlay: str | None, plot: str | None) -> list[_Outputs]:
    """Where each image's pictures go, checked before the work: folder, suffix, no file for two purposes."""
    if plot is not None:
        from vehanchor.pictures.plot import require_plots

        require_plots()
    overlays, plots = _names(images, "--overlay", overlay), _names(images, "--plot", plot)
    chosen = [path for path in (*overlays, *plots) if path is not None]
    if chosen:
        from vehanchor.pictures.scale import check_picture_path

        inputs = {Path(source).resolve() for source in images}
        seen: set[Path] = set()
        for path in chosen:
            resolved = check_picture_path(path).resolve()
            if resolved in inputs:
                raise InvalidParameterError(f"{str(path)!r} is one of the images: writing there would destroy it")
            if resolved in seen:
                raise InvalidParameterError(f"two pictures would both be written to {str(path)!r}: choose other names")
            seen.add(resolved)
    return [_Outputs(first, second) for first, second in zip(overlays, plots, strict=True)]


def _names(images: Sequence[str], option: str, pattern: str | None) -> list[Path | None]:
    if pattern is None:
        return [None] * len(images)
    if len(images) > 1 and _STEM not in pattern:
        raise InvalidParameterError(
            f"{option} {pattern!r} names one file for {len(images)} images: put {_STEM} into the name, as in "
            f"{option} '{_STEM}_{option.lstrip('-')}.png'"
        )
    return [Path(pattern.replace(_STEM, Path(source).stem)) for source in images]


def _alpha(text: str) -> float | None:
    if text.strip().lower() in ("none", "off"):
        return None
    try:
        return float(text)
    except ValueError:
        raise InvalidParameterError(f"--alpha is {text!r}: use a number > 0, or 'none'") from None


def _scale_options(**choices: Any) -> ScaleOptions:
    from vehanchor.estimate import ScaleOptions

    return ScaleOptions(**choices)


def _calibration(file: str | None) -> Calibration | None:
    from vehanchor.scale.calibration import opened_calibration

    return opened_calibration(file)


def _analyse(
    source: str, options: ScaleOptions, model: Detector, progress: Callable[[int, int], None] | None
) -> ScaleAnalysis:
    from vehanchor.estimate import analyse_scale

    return analyse_scale(source, options, detector=model, progress=progress)


def _write_pictures(source: str, analysis: ScaleAnalysis, options: ScaleOptions, outputs: _Outputs) -> None:
    if outputs.overlay is not None:
        from vehanchor.imagery.raster import open_raster
        from vehanchor.pictures.scale import draw_overlay, read_reduced, write_picture

        with open_raster(source, bands=options.bands, limits=options.limits) as raster:
            image = read_reduced(raster)
        write_picture(outputs.overlay, draw_overlay(image, analysis))
    if outputs.plot is not None:
        from vehanchor.pictures.plot import plot_scale, write_plot

        write_plot(outputs.plot, plot_scale(analysis))


# --- Tables ----------------------------------------------------------------------------------------------------------


def _estimate_table(source: str, record: GsdEstimate) -> Table:
    guard = "; capped by the resolution guard" if record.resolution_guard else ""
    facts = [
        ("scale", scale_text(record.gsd_m_per_px, record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px)),
        ("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}{guard}"),
        ("vehicles", f"{record.n_vehicles} kept of {record.n_detections} found"),
    ]
    size = f"{record.image_width_px} x {record.image_height_px} px"
    if record.gsd_m_per_px is not None and record.mode_length_px is not None:
        found_at = f", found at {record.working_scale:g} of the size" if record.working_scale not in (None, 1) else ""
        told = " by the vehicles' look" if record.reference_source == "appearance" else ""
        found = f"{record.mode_length_px:.1f} px ({record.aggregation})"
        facts.append(("modal length", f"{found} = {record.reference_length_m:.4g} m{told}{found_at}"))
        width_m, height_m = (side * record.gsd_m_per_px for side in (record.image_width_px, record.image_height_px))
        size += f" = {width_m:.4g} x {height_m:.4g} m"
    facts.append(("image", size))
    if record.frame is not None:
        seen = record.frame
        scale = scale_text(seen.gsd_m_per_px, seen.gsd_ci95_low_m_per_px, seen.gsd_ci95_high_m_per_px)
        facts.append(("your frame", f"{seen.width_px} x {seen.height_px} px: {scale}"))
    if record.georeference_gsd_m_per_px is not None:
        facts.append(("file's own scale", f"{record.georeference_gsd_m_per_px:.4g} m/px"))
    facts.append(("model", f"{record.model} ({record.model_sha256[:_SHORT_SHA]})"))
    return facts_table(source, facts)


def _summary_table(rows: Sequence[tuple[str, GsdEstimate]]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("image", overflow="fold")
    for heading in ("m/px", "95 %", "confidence", "vehicles"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("status", no_wrap=True)
    for source, record in rows:
        low, high = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
        table.add_row(
            Text(printable(source)),
            "-" if record.gsd_m_per_px is None else f"{record.gsd_m_per_px:.4g}",
            "-" if low is None or high is None else f"{low:.4g} to {high:.4g}",
            f"{record.confidence:.2f}",
            str(record.n_vehicles),
            record.status,
        )
    return table


# --- scene -----------------------------------------------------------------------------------------------------------


@app.command()
def scene(
    out: Annotated[
        Path, typer.Argument(metavar="OUT.png", help="The image, .png or .jpg; its truth is written beside it.")
    ],
    gsd: Annotated[float, typer.Option(metavar="M/PX", help="Ground sampling distance, metres per pixel: 0.005 to 2.")],
    size: Annotated[tuple[int, int], typer.Option(metavar="W H", help="Size of the image, pixels.")] = (1024, 1024),
    seed: Annotated[int, typer.Option(metavar="N", help="The same seed and options draw the same picture.")] = 0,
    vehicles: Annotated[
        int | None,
        typer.Option(metavar="N", help="At most so many cars; 0 for none at all. Default: as many as the place has."),
    ] = None,
    fleet: Annotated[float, typer.Option(metavar="M", help="Mean length of the cars, metres: 2 to 8.")] = 4.6,
    layout: Annotated[_Layout | None, typer.Option(help="Kind of place. Default: the seed decides.")] = None,
) -> None:
    """Render an aerial scene of exactly known scale, with its truth: GSD, oriented boxes (DOTA text), masks."""
    with told_errors():
        from vehanchor.pictures.scale import check_picture_path
        from vehanchor_scenes import render_scene

        check_picture_path(out)
        drawn = render_scene(
            gsd,
            width_px=size[0],
            height_px=size[1],
            seed=seed,
            n_vehicles=vehicles,
            mean_vehicle_length_m=fleet,
            layout=None if layout is None else layout.value,
        )
        try:
            written = drawn.write(out)
        except OSError as error:
            raise OutputError(f"cannot write {str(out)!r}: {error.strerror or error}") from error
        n_small = sum(vehicle.kind == "small-vehicle" for vehicle in drawn.vehicles)
        n_large = len(drawn.vehicles) - n_small
        print(f"{size[0]} x {size[1]} px at {gsd:g} m/px, {n_small} small and {n_large} large vehicles:")
        for path in written:
            print(printable(f"  {path}"))


# --- models ----------------------------------------------------------------------------------------------------------


@_models.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object per model and line.")] = False,
) -> None:
    """List the bundled detectors and the segmenter."""
    with told_errors():
        from vehanchor.models.zoo import DEFAULT_DETECTOR, bundled_models, bundled_segmenter

        files = bundled_models()
        if not files and not as_json:
            print("no bundled models: pass the path of an ONNX file with --detector", file=sys.stderr)
        for name, path in files.items():
            default = name == DEFAULT_DETECTOR
            try:
                card = open_detector(str(path), None).card
            except ModelError as error:
                if as_json:
                    print_json(failure(str(path), error))
                else:
                    print(printable(f"{name}: {path}\n  not a detector: {error}"))
                continue
            if as_json:
                print_json({"kind": "detector", "file": str(path), "default": default, **card.model_dump(mode="json")})
            else:
                facts = [("file", str(path)), *_card_facts(card, sha_digits=_SHORT_SHA)]
                print_table(facts_table(f"{name} (default)" if default else name, facts))
        halves = bundled_segmenter()
        if halves is not None:
            _list_segmenter(*halves, as_json=as_json)


def _list_segmenter(encoder: Path, decoder: Path, *, as_json: bool) -> None:
    from vehanchor.segmentation.segmenter import load_segmenter

    card = load_segmenter(encoder, decoder).card
    if as_json:
        print_json({"kind": "segmenter", "encoder": str(encoder), "decoder": str(decoder), **asdict(card)})
        return
    facts = [
        ("encoder", str(encoder)),
        ("decoder", str(decoder)),
        ("sha256", card.sha256[:_SHORT_SHA]),
        ("input", f"{card.input_px} px a side, {card.contract} contract"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
    ]
    print_table(facts_table(f"{card.name} (segmenter of measure)", facts))


@_models.command("info")
def show_model(
    file: Annotated[str, typer.Argument(metavar="FILE", help="An ONNX file, or the name of a bundled model.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, and nothing else.")] = False,
    classes: Annotated[
        list[str] | None,
        typer.Option(
            "--class", metavar="NAME", help="Class that counts as a vehicle, where the model's own is unclear."
        ),
    ] = None,
) -> None:
    """Show all that a detector's file says of itself; the paper's values stand in where it is silent."""
    with told_errors():
        try:
            model = open_detector(file, classes)
        except VehAnchorError as error:
            if as_json:
                print_json(failure(file, error))
            raise
        if as_json:
            print_json(
                {"file": str(model.path), "fixed_size_px": model.fixed_size, **model.card.model_dump(mode="json")}
            )
            return
        card = model.card
        size = "any" if model.fixed_size is None else f"{model.fixed_size[1]} x {model.fixed_size[0]} px"
        regions = ", ".join(f"{name} {length:.4g} m" for name, length in sorted(card.region_lengths_m.items()))
        facts = [
            ("file", str(model.path)),
            ("input", size),
            ("classes", ", ".join(card.class_names.values()) or "not named"),
            *_card_facts(card, sha_digits=len(card.sha256)),
            ("regions", regions),
        ]
        print_table(facts_table(card.name, facts))


def _card_facts(card: DetectorCard, *, sha_digits: int) -> list[tuple[str, str]]:
    shortest, longest = card.length_range_px
    fleets = card.fleet_lengths
    told = "" if fleets is None else f"; by the vehicles' look {fleets.length_m[0]:.4g} to {fleets.length_m[1]:.4g} m"
    unbiased = f"; measured without bias from {card.min_length_px:g} px" if card.min_length_px else ""
    return [
        ("sha256", card.sha256[:sha_digits]),
        (
            "reference length",
            f"{card.reference_length_m:.4g} m, sd {card.reference_length_sd_m:.2g} m between regions{told}",
        ),
        ("vehicle lengths", f"{shortest:g} to {longest:g} px{unbiased}"),
        ("minimum score", f"{card.min_score:g}"),
        ("licence", card.licence or "not stated"),
    ]


# --- Commands of their own modules -----------------------------------------------------------------------------------

app.command(cls=PointsCommand)(measure)
app.command()(batch)
app.add_typer(evaluate, name="evaluate")
app.command(cls=FilesCommand)(calibrate)
app.command()(serve)
app.command()(schemas)
