"""``vehanchor estimate``: scales of photographs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.outputs import check_outputs, write_outputs
from vehanchor.cli.terminal import (
    BAD_INPUT,
    NOT_OK,
    NUMBER,
    STATUS_TEXTS,
    TEXT,
    WORD,
    Strict,
    columns_table,
    exit_on_error,
    exit_strictly,
    facts_table,
    failure,
    print_json,
    print_table,
    print_warnings,
    printable,
    report,
    scale_text,
    span_text,
    tile_progress,
    under_one_folder,
    vehicles_text,
)
from vehanchor.errors import ImageNotFoundError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.records.text import advice_for, significant

if TYPE_CHECKING:
    from rich.table import Table

    from vehanchor.engine import Engine
    from vehanchor.records import EstimateDetails, GsdEstimate, RulerScale, TiltEstimate

_STEM = "{stem}"
_SHORT_SHA = 12


OverlayFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write the image with vehicles and scale bar. '{stem}' in the name stands for the image's name without "
        "suffix; it is required for several images.",
    ),
]
PlotFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write a plot of lengths, mode and interval (extra 'plots'); '{stem}' as above.",
        hidden=True,
    ),
]
BoxesFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.geojson",
        help="Write the vehicles as GeoJSON: degrees if georeferenced, else pixels; '{stem}' as above.",
    ),
]
ScaleBarFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write the photograph with a scale bar alone; without a single usable scale nothing, and exit status "
        f"{NOT_OK}.",
    ),
]
GeotiffFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.tif",
        help="Write the photograph in full size as a GeoTIFF in local metres, as --scale-bar; needs the extra 'geo'.",
    ),
]


@scale_command()
def estimate(
    images: Annotated[
        list[str],
        typer.Argument(metavar="IMAGE", help=f"Photographs: {', '.join(IMAGE_FORMATS)}.", show_default=False),
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object per image and line, and nothing else.")
    ] = False,
    overlay: OverlayFile = None,
    plot: PlotFile = None,
    boxes: BoxesFile = None,
    scale_bar: ScaleBarFile = None,
    geotiff: GeotiffFile = None,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the ground sampling distance (metres per pixel) of aerial images from the cars in them."""
    with exit_on_error():
        try:
            _refuse_folders(images)
            if len(images) > 1:
                chosen.options().by_hand.check_single()
            files = {"overlay": overlay, "plot": plot, "boxes": boxes, "scale_bar": scale_bar, "geotiff": geotiff}
            outputs = _outputs(images, files)
            engine = chosen.engine()
            engine.load()
        except VehAnchorError as error:
            if as_json:  # one line for every image
                for source in images:
                    print_json(failure(source, error))
            raise
        rows, n_failed, n_refused = _estimate_all(images, engine, outputs, as_json=as_json)
        if rows and not as_json:
            print_table(_summary_table(rows) if len(images) > 1 else _estimate_table(*rows[0]))
            for source, record in rows:
                print_warnings(record, source if len(images) > 1 else "")
        if n_failed or n_refused:
            raise typer.Exit(BAD_INPUT if n_failed else NOT_OK)
        exit_strictly(strict, (record.status for _, record in rows))


def _refuse_folders(images: Sequence[str]) -> None:
    folder = next((source for source in images if Path(source).is_dir()), None)
    if folder is not None:
        raise ImageNotFoundError(
            f"{folder!r} is a folder: 'vehanchor batch {folder} -o scales.csv' measures all images in it"
        )


def _estimate_all(
    images: Sequence[str], engine: Engine, outputs: Sequence[Mapping[str, Path]], *, as_json: bool
) -> tuple[list[tuple[str, GsdEstimate]], int, int]:
    """Estimate all images; return the records, the number of errors, and of images without metric outputs."""
    rows: list[tuple[str, GsdEstimate]] = []
    n_failed = n_refused = 0
    with tile_progress(len(images), lines_on_terminal=as_json and sys.stdout.isatty()) as step:
        for number, source in enumerate(images):
            try:
                analysis = engine.analyse_scale(source, progress=step(number, source))
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
                why = write_outputs(analysis, outputs[number])
                if why is not None:
                    n_refused += 1
                    print(printable(f"{source}: no scale bar and no GeoTIFF: {why}"), file=sys.stderr)
            except VehAnchorError as error:
                n_failed += 1
                report(error, source if len(images) > 1 else "")
    return rows, n_failed, n_refused


def _outputs(images: Sequence[str], patterns: Mapping[str, str | None]) -> list[dict[str, Path]]:
    """Choose the output files of each image by their options, and check them before the work."""
    named = {name: _names(images, f"--{name.replace('_', '-')}", each) for name, each in patterns.items() if each}
    check_outputs(images, ((name, path) for name, paths in named.items() for path in paths))
    return [{name: paths[number] for name, paths in named.items()} for number in range(len(images))]


def _names(images: Sequence[str], option: str, pattern: str) -> list[Path]:
    if len(images) > 1 and _STEM not in pattern:
        raise InvalidParameterError(
            f"{option} {pattern!r} names one file for {len(images)} images: add {_STEM} to the name, as in "
            f"{option} '{_STEM}_{option.lstrip('-')}{Path(pattern).suffix}'"
        )
    return [Path(pattern.replace(_STEM, Path(source).stem)) for source in images]


def _estimate_table(source: str, record: GsdEstimate) -> Table:
    fused = any(ruler.sets_scale and ruler.kind != "vehicles" for ruler in record.rulers)
    guard = "; the vehicles are too coarse" if record.details.resolution_guard and not fused else ""
    facts = [
        ("scale", scale_text(record.gsd_m_per_px, record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px)),
        ("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}{guard}"),
        ("vehicles", vehicles_text(record)),
    ]
    if fused:
        facts += [("" if row else "rulers", _ruler_text(ruler)) for row, ruler in enumerate(record.rulers)]
    if advice := advice_for(record, "look at --overlay, then --drop what is no car"):
        facts.append(("not usable", f"{advice.why}: {advice.helps}"))
    size = f"{record.image_width_px} x {record.image_height_px} px"
    if record.gsd_m_per_px is not None and record.mode_length_px is not None:
        facts.append(("modal length", _length_text(record.mode_length_px, record.details)))
    if record.gsd_m_per_px is not None and record.tilt is None:
        width_m, height_m = (side * record.gsd_m_per_px for side in (record.image_width_px, record.image_height_px))
        size += f" = {significant(width_m, 4)} x {significant(height_m, 4)} m"
    if record.tilt is not None:
        facts.append(("tilt", _tilt_text(record.tilt)))
    facts.append(("image", size))
    if record.frame is not None:
        seen = record.frame
        scale = scale_text(seen.gsd_m_per_px, seen.gsd_ci95_low_m_per_px, seen.gsd_ci95_high_m_per_px)
        facts.append(("your frame", f"{seen.width_px} x {seen.height_px} px: {scale}"))
    if record.georeference_gsd_m_per_px is not None:
        facts.append(("file's own scale", f"{significant(record.georeference_gsd_m_per_px, 4)} m/px"))
    facts.append(("model", f"{record.model} ({record.details.model_sha256[:_SHORT_SHA]})"))
    return facts_table(source, facts)


def _length_text(mode_px: float, details: EstimateDetails) -> str:
    scale = details.working_scale
    found_at = "" if scale is None or scale == 1 else f", found at {scale:g} of the size"
    told = " by the vehicles' appearance" if details.reference_source == "appearance" else ""
    metres = significant(details.reference_length_m or 0, 4)
    return f"{mode_px:.1f} px ({details.aggregation}) = {metres} m{told}{found_at}"


def _ruler_text(ruler: RulerScale) -> str:
    """Describe a ruler's scale, and the chance that it is right."""
    return f"{ruler.label} {significant(ruler.gsd_m_per_px, 4)} m/px, right with a chance of {ruler.p_right:.2f}"


def _tilt_text(tilt: TiltEstimate) -> str:
    text = f"{tilt.tilt_deg:.0f} degrees (95 %: {tilt.tilt_ci95_low_deg:.0f} to {tilt.tilt_ci95_high_deg:.0f}), "
    text += f"by {tilt.source}"
    if tilt.gsd_least_m_per_px is None or tilt.gsd_largest_m_per_px is None:
        return text
    least, largest = (significant(each, 4) for each in (tilt.gsd_least_m_per_px, tilt.gsd_largest_m_per_px))
    return f"{text}; the scale is that of the centre, {least} to {largest} m/px over the image"


def _summary_table(rows: Sequence[tuple[str, GsdEstimate]]) -> Table:
    folder, names = under_one_folder([source for source, _ in rows])
    columns = {"image": TEXT, **dict.fromkeys(("m/px", "95 %", "confidence", "vehicles"), NUMBER), "status": WORD}
    cells = [
        (
            name,
            "-" if record.gsd_m_per_px is None else significant(record.gsd_m_per_px, 4),
            span_text(record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px, 4),
            f"{record.confidence:.2f}",
            "-" if record.n_vehicles is None else str(record.n_vehicles),
            record.status,
        )
        for name, (_, record) in zip(names, rows, strict=True)
    ]
    title = f"{len(rows)} images in {folder}" if folder else ""
    return columns_table(columns, cells, title)
