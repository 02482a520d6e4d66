"""``vehanchor estimate``: scales of photographs."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.outputs import check_outputs, write_outputs
from vehanchor.cli.terminal import (
    BAD_INPUT,
    NOT_OK,
    STATUS_TEXTS,
    Strict,
    exit_strictly,
    failures_as_json,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    printable,
    report,
    under_one_folder,
    vehicles_text,
    work_progress,
)
from vehanchor.errors import ImageNotFoundError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.records.text import advice_for, count, scale_text, significant

if TYPE_CHECKING:
    from vehanchor.engine import Engine
    from vehanchor.records import EstimateDetails, GsdEstimate, TiltEstimate

_STEM = "{stem}"
_SHORT_SHA = 12


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
        help="Write a plot of lengths, mode and interval (extra 'plots'); '{stem}' as above.",
        hidden=True,
    ),
]
BoxesFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.geojson",
        help="Write the vehicles as GeoJSON: degrees if georeferenced, else pixels; '{stem}' as "
        "above.",
    ),
]
ScaleBarFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.png",
        help="Write the photograph with a scale bar alone; without a single usable scale nothing, "
        f"and exit status {NOT_OK}.",
    ),
]
GeotiffFile: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="OUT.tif",
        help="Write the photograph in full size as a GeoTIFF in local metres, as --scale-bar; "
        "needs the extra 'geo'.",
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
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the ground sampling distance (metres per pixel) of aerial images from the cars in them."""
    with failures_as_json(images, as_json):
        folder = next((source for source in images if Path(source).is_dir()), None)
        if folder is not None:
            raise ImageNotFoundError(
                f"{folder!r} is a folder: 'vehanchor batch {folder} -o scales.csv' measures all "
                "images in it"
            )
        if len(images) > 1:
            chosen.options().by_hand.check_single()
        files = {
            "overlay": overlay,
            "plot": plot,
            "boxes": boxes,
            "scale_bar": scale_bar,
            "geotiff": geotiff,
        }
        outputs = _outputs(images, files)
        engine = chosen.engine()
        engine.load()
    rows, n_failed, n_refused = _estimate_all(images, engine, outputs, as_json=as_json)
    if rows and not as_json:
        _print_summary(rows) if len(images) > 1 else print_facts(rows[0][0], _facts(rows[0][1]))
        for source, record in rows:
            print_warnings(record.warnings, source if len(images) > 1 else "")
    if n_failed or n_refused:
        raise typer.Exit(BAD_INPUT if n_failed else NOT_OK)
    exit_strictly(strict, (record.status for _, record in rows))


def _estimate_all(
    images: Sequence[str], engine: Engine, outputs: Sequence[Mapping[str, Path]], *, as_json: bool
) -> tuple[list[tuple[str, GsdEstimate]], int, int]:
    """Estimate all images; return the records, the number of errors, and of images without metric outputs."""
    rows: list[tuple[str, GsdEstimate]] = []
    n_failed = n_refused = 0
    with work_progress("tiles", lines=as_json and sys.stdout.isatty()) as tell:
        for number, source in enumerate(images):
            try:
                with failures_as_json([source], as_json):
                    name = (f"{number + 1}/{len(images)} " if len(images) > 1 else "") + Path(
                        source
                    ).name
                    analysis = engine.analyse_scale(source, progress=partial(tell, name=name))
                if as_json:
                    print_json({"source": source, **analysis.estimate.model_dump(mode="json")})
                rows.append((source, analysis.estimate))
                why = write_outputs(analysis, outputs[number])
            except VehAnchorError as error:
                n_failed += 1
                report(error, source if len(images) > 1 else "")
                continue
            if why is not None:
                n_refused += 1
                print(printable(f"{source}: no scale bar and no GeoTIFF: {why}"), file=sys.stderr)
    return rows, n_failed, n_refused


def _outputs(images: Sequence[str], patterns: Mapping[str, str | None]) -> list[dict[str, Path]]:
    """Choose the output files of each image by their options, and check them before the work."""
    named = {
        name: _names(images, f"--{name.replace('_', '-')}", each)
        for name, each in patterns.items()
        if each
    }
    check_outputs(images, ((name, path) for name, paths in named.items() for path in paths))
    return [{name: paths[number] for name, paths in named.items()} for number in range(len(images))]


def _names(images: Sequence[str], option: str, pattern: str) -> list[Path]:
    if len(images) > 1 and _STEM not in pattern:
        raise InvalidParameterError(
            f"{option} {pattern!r} names one file for {len(images)} images: add {_STEM} to the "
            f"name, as in {option} '{_STEM}_{option.lstrip('-')}{Path(pattern).suffix}'"
        )
    return [Path(pattern.replace(_STEM, Path(source).stem)) for source in images]


def _facts(record: GsdEstimate) -> list[tuple[str, str]]:
    fused = any(ruler.sets_scale and ruler.kind != "vehicles" for ruler in record.rulers)
    guard = "; the vehicles are too coarse" if record.details.resolution_guard and not fused else ""
    facts = [
        ("scale", scale_text(record)),
        ("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}{guard}"),
        ("vehicles", vehicles_text(record)),
    ]
    if fused:
        for row, each in enumerate(record.rulers):
            scale = f"{each.label} {significant(each.gsd_m_per_px, 4)} m/px"
            facts.append(
                ("" if row else "rulers", f"{scale}, right with a chance of {each.p_right:.2f}")
            )
    if advice := advice_for(record, "look at --overlay, then --drop what is no car"):
        facts.append(("not usable", f"{advice.why}: {advice.helps}"))
    size = f"{record.image_width_px} x {record.image_height_px} px"
    if record.gsd_m_per_px is not None and record.mode_length_px is not None:
        facts.append(("modal length", _length_text(record.mode_length_px, record.details)))
    if record.gsd_m_per_px is not None and record.tilt is None:
        width_m, height_m = (
            side * record.gsd_m_per_px for side in (record.image_width_px, record.image_height_px)
        )
        size += f" = {significant(width_m, 4)} x {significant(height_m, 4)} m"
    if record.tilt is not None:
        facts.append(("tilt", _tilt_text(record.tilt)))
    facts.append(("image", size))
    if record.frame is not None:
        seen = record.frame
        facts.append(("your frame", f"{seen.width_px} x {seen.height_px} px: {scale_text(seen)}"))
    if record.georeference_gsd_m_per_px is not None:
        facts.append(
            ("file's own scale", f"{significant(record.georeference_gsd_m_per_px, 4)} m/px")
        )
    facts.append(("model", f"{record.model} ({record.details.model_sha256[:_SHORT_SHA]})"))
    return facts


def _length_text(mode_px: float, details: EstimateDetails) -> str:
    scale = details.working_scale
    found_at = "" if scale is None or scale == 1 else f", found at {scale:g} of the size"
    told = " by the vehicles' appearance" if details.reference_source == "appearance" else ""
    metres = significant(details.reference_length_m or 0, 4)
    return f"{mode_px:.1f} px ({details.aggregation}) = {metres} m{told}{found_at}"


def _tilt_text(tilt: TiltEstimate) -> str:
    text = (
        f"{tilt.tilt_deg:.0f} degrees (95 %: {tilt.tilt_ci95_low_deg:.0f} to "
        f"{tilt.tilt_ci95_high_deg:.0f}), "
    )
    text += f"by {tilt.source}"
    if tilt.gsd_least_m_per_px is None or tilt.gsd_largest_m_per_px is None:
        return text
    least, largest = (
        significant(each, 4) for each in (tilt.gsd_least_m_per_px, tilt.gsd_largest_m_per_px)
    )
    return f"{text}; the scale is that of the centre, {least} to {largest} m/px over the image"


def _print_summary(rows: Sequence[tuple[str, GsdEstimate]]) -> None:
    folder, names = under_one_folder([source for source, _ in rows])
    columns = {
        "image": "text",
        **dict.fromkeys(("m/px", "95 %", "confidence", "vehicles"), "number"),
        "status": "word",
    }
    cells = [(name, *_cells(record)) for name, (_, record) in zip(names, rows, strict=True)]
    print_rows(columns, cells, f"{count(len(rows), 'image')} in {folder}" if folder else "")


def _cells(record: GsdEstimate) -> tuple[str, ...]:
    low = record.gsd_ci95_low_m_per_px
    high = record.gsd_ci95_high_m_per_px
    return (
        "-" if record.gsd_m_per_px is None else significant(record.gsd_m_per_px, 4),
        "-" if low is None or high is None else f"{significant(low, 4)} to {significant(high, 4)}",
        f"{record.confidence:.2f}",
        "-" if record.n_vehicles is None else str(record.n_vehicles),
        record.status,
    )
