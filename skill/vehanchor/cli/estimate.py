"""``vehanchor estimate``: scales of photographs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.estimated_file import EstimatedFile, Estimator, PhotographFile
from vehanchor.cli.outputs import check_outputs
from vehanchor.cli.terminal import (
    BAD_INPUT,
    NOT_OK,
    STATUS_TEXTS,
    UNFORESEEN,
    DefectError,
    Strict,
    contradiction_fact,
    exit_strictly,
    failures_as_json,
    first_names,
    print_error_as_json,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    print_written,
    printable,
    report,
    under_one_folder,
    vehicles_text,
    work_progress,
)
from vehanchor.errors import ImageNotFoundError, InvalidParameterError
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.records.advice import advice_for
from vehanchor.records.contradiction import contradiction_text
from vehanchor.records.text import (
    count,
    file_scale_text,
    pixel_text,
    scale_cells,
    scale_text,
    significant,
)
from vehanchor.scale.defaults import SHORT_SHA

if TYPE_CHECKING:
    from vehanchor.cli.terminal import Facts
    from vehanchor.records import EstimateDetails, GsdEstimate, TiltEstimate

    Records: TypeAlias = list[tuple[str, GsdEstimate]]
    """Records with the names of their images."""

_STEM = "{stem}"
_MAX_NAMES = 3  # of images, in an error


OverlayFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write the image with vehicles and scale bar. '{stem}' in the name stands for the "
        "image's name without suffix; it is required for several images.",
    ),
]
PlotFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write a plot of lengths, mode and interval (extra 'plots'); '{stem}' as for "
        "--overlay.",
        hidden=True,
    ),
]
BoxesFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.geojson",
        help="Write the vehicles with their sizes as GeoJSON: degrees if georeferenced, else "
        "pixels; '{stem}' as for --overlay.",
    ),
]
ScaleBarFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write the photograph with only a scale bar. Without a single usable scale, write "
        f"nothing and exit with status {NOT_OK}.",
    ),
]
GeotiffFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.tif",
        help="Write the photograph in full size as a GeoTIFF in local metres, under the conditions "
        "of --scale-bar; needs the extra 'geo'.",
    ),
]


@scale_command()
def estimate(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGE", help=f"Photographs: {', '.join(IMAGE_FORMATS)}.", show_default=False
        ),
    ],
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object per image and line, and nothing else."),
    ] = False,
    overlay: OverlayFile = None,
    plot: PlotFile = None,
    boxes: BoxesFile = None,
    scale_bar: ScaleBarFile = None,
    geotiff: GeotiffFile = None,
    details: Annotated[
        bool, typer.Option("--details", help="Also print the camera metadata that were read.")
    ] = False,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the ground sampling distance (metres per pixel) of aerial images from cars."""
    with failures_as_json(images, as_json):
        _check_images(images, chosen)
        files = {
            "overlay": overlay,
            "plot": plot,
            "boxes": boxes,
            "scale_bar": scale_bar,
            "geotiff": geotiff,
        }
        photographs = []
        for source, outputs in zip(images, _output_files(images, files), strict=True):
            photographs.append(PhotographFile(source, outputs, details=details and not as_json))
        estimator = Estimator(chosen, isolated=len(images) > 1)
    with closing(estimator):
        results = _estimate_all(photographs, estimator, as_json=as_json)
    records = []
    for source, result in zip(images, results, strict=True):
        if result.estimate is not None:
            records.append((source, result.estimate))
    if records and not as_json:
        _print_records(records, several=len(images) > 1)
        for result in results:
            if result.metadata:
                print_facts("", result.metadata)
    errors = [result.error for result in results if result.error is not None]
    if any(isinstance(error, DefectError) for error in errors):
        raise typer.Exit(UNFORESEEN)
    if errors:
        raise typer.Exit(BAD_INPUT)
    if any(result.why_refused is not None for result in results):
        raise typer.Exit(NOT_OK)
    exit_strictly(strict, [record.status for _, record in records])


def _check_images(images: Sequence[str], chosen: ParsedOptions) -> None:
    """Refuse folders, and what belongs to one photograph for several."""
    for source in images:
        if Path(source).is_dir():
            raise ImageNotFoundError(
                f"{source!r} is a folder: 'vehanchor batch {source} --out scales.csv' measures all "
                "images in it"
            )
    if len(images) == 1:
        return
    try:
        chosen.options().check_for_several_images()
    except InvalidParameterError as error:
        # Any further word of the command counts as an image, such as the unit of a length.
        names = ", ".join(map(repr, images[:_MAX_NAMES]))
        raise InvalidParameterError(f"{error}. The images here begin with {names}") from None


def _output_files(
    images: Sequence[str], patterns: Mapping[str, str | None]
) -> list[dict[str, Path]]:
    """Name the output files of each image by their options, and check them before the work."""
    paths_by_name: dict[str, list[Path]] = {}
    for name, pattern in patterns.items():
        if pattern:
            option = f"--{name.replace('_', '-')}"
            paths_by_name[name] = _expand_pattern(images, option, pattern)
    all_outputs: list[tuple[str, Path]] = []
    outputs_by_image: list[dict[str, Path]] = [{} for _ in images]
    for name, paths in paths_by_name.items():
        for path, outputs in zip(paths, outputs_by_image, strict=True):
            all_outputs.append((name, path))
            outputs[name] = path
    check_outputs(images, all_outputs)
    return outputs_by_image


def _expand_pattern(images: Sequence[str], option: str, pattern: str) -> list[Path]:
    """Replace ``{stem}`` in the name of an output by the name of each image."""
    if len(images) > 1 and _STEM not in pattern:
        suffix = Path(pattern).suffix
        raise InvalidParameterError(
            f"{option} {pattern!r} names one file for {len(images)} images: add {_STEM} to the "
            f"name, as in {option} '{_STEM}_{option.lstrip('-')}{suffix}'"
        )
    stems = [Path(source).stem for source in images]
    return [Path(pattern.replace(_STEM, stem)) for stem in stems]


def _estimate_all(
    photographs: Sequence[PhotographFile], estimator: Estimator, *, as_json: bool
) -> list[EstimatedFile]:
    """Estimate all photographs, and report what is wrong with each."""
    results: list[EstimatedFile] = []
    all_written: list[Path] = []
    several = len(photographs) > 1
    # A bar on the terminal would mix with the JSON lines there.
    no_bar = as_json and sys.stdout.isatty()
    with work_progress("tiles", lines=no_bar) as tell:
        for number, photograph in enumerate(photographs, start=1):
            source = photograph.source
            name = Path(source).name
            if several:
                name = f"{number}/{len(photographs)} {name}"
            result = estimator.estimate(photograph, partial(tell, name=name))
            results.append(result)
            all_written += result.written
            if as_json:
                _print_as_json(source, result)
            if result.error is not None:
                report(result.error, source if several else "")
            if result.why_refused is not None:
                message = f"{source}: no scale bar and no GeoTIFF: {result.why_refused}"
                print(printable(message), file=sys.stderr)
    print_written(all_written)
    return results


def _print_as_json(source: str, result: EstimatedFile) -> None:
    """Print the record of a photograph, or the error that it has instead, in one line."""
    if result.estimate is not None:
        fields = result.estimate.model_dump(mode="json")
        print_json({"photograph": source, **fields})
    elif result.error is not None:
        print_error_as_json(source, result.error)


def _print_records(records: Records, *, several: bool) -> None:
    """Print the facts of one image, or a table of several; the warnings follow on stderr."""
    if several:
        for source, record in records:
            contradiction = contradiction_text(record)
            if contradiction:
                print(printable(f"{source}: {contradiction}"))
        _print_table(records)
    else:
        [(source, record)] = records
        print_facts(source, _facts(record))
    for source, record in records:
        print_warnings(record.warnings, source if several else "")


def _facts(record: GsdEstimate) -> Facts:
    """List the facts of a record for people, with their names."""
    setting = [ruler.kind for ruler in record.rulers if ruler.sets_scale]
    other_rulers = any(kind != "vehicles" for kind in setting)
    confidence = f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}"
    if record.details.resolution_guard and not other_rulers:
        confidence += "; the vehicles are too coarse"
    facts = [
        *contradiction_fact(record),
        ("scale", scale_text(record)),
        ("confidence", confidence),
        ("vehicles", vehicles_text(record)),
    ]
    if other_rulers:
        facts += _ruler_facts(record)
    advice = _advice_text(record)
    if advice is not None:
        facts.append(("not usable", advice))
    mode_px = record.mode_length_px
    if record.gsd_m_per_px is not None and mode_px is not None:
        facts.append(("modal length", _length_text(mode_px, record.details)))
    if record.tilt is not None:
        facts.append(("tilt", _tilt_text(record.tilt)))
    facts.append(("image", _size_text(record)))
    pixel = pixel_text(record.gsd_m_per_px, record.details.pixel_aspect)
    if pixel:
        facts.append(("pixels of the file", pixel))
    frame = record.frame
    if frame is not None:
        text = f"{frame.width_px} x {frame.height_px} px: {scale_text(frame)}"
        facts.append(("your frame", text))
    file_scale = file_scale_text(record)
    if file_scale:
        facts.append(("file's own scale", file_scale))
    sha256 = record.details.model_sha256[:SHORT_SHA]
    facts.append(("model", f"{record.model} ({sha256})"))
    return facts


def _advice_text(record: GsdEstimate) -> str | None:
    """State why a scale is not usable and what helps; None for a usable one."""
    advice = advice_for(record)
    if advice is None:
        return None
    helps = advice.in_words({"drop": "look at --overlay, then --drop what is not a car"})
    return f"{advice.why}: {helps}"


def _ruler_facts(record: GsdEstimate) -> Facts:
    """List the rulers below one name."""
    facts = []
    name = "rulers"
    for ruler in record.rulers:
        scale = f"{ruler.label} {significant(ruler.gsd_m_per_px, 4)} m/px"
        facts.append((name, f"{scale}, right with a chance of {ruler.p_right:.2f}"))
        name = ""
    return facts


def _size_text(record: GsdEstimate) -> str:
    """Format the size of the image in pixels, and in metres if one scale holds for all of it."""
    size = f"{record.image_width_px} x {record.image_height_px} px"
    if record.gsd_m_per_px is None or record.tilt is not None:
        return size
    aspect = record.details.pixel_aspect or 1.0
    grid = PixelGrid(record.image_width_px, record.image_height_px, aspect)
    width = significant(grid.square_width_px * record.gsd_m_per_px, 4)
    height = significant(grid.square_height_px * record.gsd_m_per_px, 4)
    return f"{size} = {width} x {height} m"


def _length_text(mode_px: float, details: EstimateDetails) -> str:
    """Format the modal length in pixels and metres, with the source of the metres."""
    metres = significant(details.reference_length_m or 0, 4)
    text = f"{mode_px:.1f} px ({details.aggregation}) = {metres} m"
    if details.reference_source == "appearance":
        text += " by the vehicles' appearance"
    if details.working_scale not in (None, 1):
        text += f", found at {details.working_scale:g} of the size"
    return text


def _tilt_text(tilt: TiltEstimate) -> str:
    """Format the tilt with its interval and the scales in the image."""
    low = f"{tilt.tilt_ci95_low_deg:.0f}"
    high = f"{tilt.tilt_ci95_high_deg:.0f}"
    text = f"{tilt.tilt_deg:.0f} degrees (95 %: {low} to {high}), by {tilt.source}"
    if tilt.gsd_least_m_per_px is None or tilt.gsd_largest_m_per_px is None:
        return text
    smallest = significant(tilt.gsd_least_m_per_px, 4)
    largest = significant(tilt.gsd_largest_m_per_px, 4)
    return f"{text}; the scale is that of the centre, {smallest} to {largest} m/px over the image"


def _print_table(records: Records) -> None:
    """Print a table with one row per image."""
    folder, names = under_one_folder([source for source, _ in records])
    columns = {
        "photograph": "file",
        "m/px": "number",
        "95 % if right": "number",
        "conf.": "number",
        "cars": "number",
        "status": "word",
        "reason": "word",
    }
    rows = []
    for name, (_, record) in zip(names, records, strict=True):
        rows.append((name, *_cells(record)))
    title = f"{count(len(records), 'photograph')} in {folder}" if folder else ""
    print_rows(columns, rows, title)
    names_by_advice: dict[str, list[str]] = {}
    for name, (_, record) in zip(names, records, strict=True):
        advice = _advice_text(record)
        if advice is not None:
            names_by_advice.setdefault(advice, []).append(name)
    for advice, advised in names_by_advice.items():
        print(printable(f"{first_names(advised)}: {advice}"), file=sys.stderr)


def _cells(record: GsdEstimate) -> tuple[str, ...]:
    """Format the cells of a record in the table of several images; "-" for a missing value."""
    scale, interval = scale_cells(record)
    n_vehicles = "-" if record.n_vehicles is None else str(record.n_vehicles)
    reason = record.reason or ""
    return scale, interval, f"{record.confidence:.2f}", n_vehicles, record.status, reason
