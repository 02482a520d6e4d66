"""``vehanchor flight photographs``: scales of a flight's photographs from their common evidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.batch import OverlayFolder
from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.scale_option import KnownLengthsFile
from vehanchor.cli.terminal import (
    STATUS_TEXTS,
    AsJson,
    first_names,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    print_written,
    resumable,
    under_one_folder,
    work_progress,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.records.text import count, scale_cells, scale_text, significant
from vehanchor.storage.atomic import beside, check_output_path, write_record

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from vehanchor.batch.row import BatchRow
    from vehanchor.options import ImageLimits
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.records import FlightEstimate, FlightPhotograph

_MAX_SIZES = 12  # Of components, in one line.

Every: TypeAlias = Annotated[
    float, typer.Option(metavar="S", help="For a video: seconds between photographs.")
]
First: TypeAlias = Annotated[
    float | None,
    typer.Option(metavar="S", help="For a video: use its first seconds alone. Default: all of it."),
]


@scale_command(without=OF_ONE_IMAGE)
def photographs(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="PHOTOS",
            help="Photographs of one flight, directories, patterns such as 'flight/*.jpg'; or "
            "one video.",
            show_default=False,
        ),
    ],
    same_scale: Annotated[
        bool,
        typer.Option(
            "--same-scale",
            help="All photographs have one scale, as in a survey at one height: pool their "
            "evidence.",
        ),
    ] = False,
    as_json: AsJson = False,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FLIGHT.json",
            help="Write the record, for 'measure --scale'. After an interruption, the same "
            "command resumes the run.",
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Write a table with a row for each photograph, as 'batch' does."
        ),
    ] = None,
    overlays: OverlayFolder = None,
    known_lengths: KnownLengthsFile = None,
    every: Every = 2.0,
    first: First = None,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the scales of the photographs of one flight from their common evidence."""
    from vehanchor.batch.table import check_table_path
    from vehanchor_flight.verbs import estimate_flight

    if out is not None:
        out = check_output_path(out, (".json",), kind="a record")
    if table is not None:
        table = check_table_path(table)
    journal = _journal_beside(out or table)
    images = _images(inputs, every, first, chosen.options().reading.limits)
    if overlays is not None and not isinstance(images, Sequence):
        raise InvalidParameterError("--overlays needs photographs: a video has none to draw over")
    last_step = "pooling the evidence of" if same_scale else "linking"
    # The length of a video is unknown: its number of photographs is never complete.
    is_counted = isinstance(images, Sequence)
    with work_progress("images") as show_progress, resumable(journal):

        def report_progress(n_done: int, n_images: int) -> None:
            step = "searching"
            if is_counted and n_done == n_images:
                step = last_step
            show_progress(n_done, n_images, step)

        record = estimate_flight(
            images,
            engine=chosen.engine(),
            same_scale=same_scale,
            known_lengths_table=known_lengths,
            journal=journal,
            overlays=overlays,
            progress=report_progress,
        )
    _write(record, out, table)
    if overlays is not None:
        print_written([overlays])
    if as_json:
        print_json(record.model_dump(mode="json"))
    else:
        _print_record(record)


def _journal_beside(result_file: Path | None) -> Path | None:
    """Name the journal that lets the same command resume; None without a file of results."""
    if result_file is None:
        return None
    return beside(result_file, ".journal")


def _images(
    inputs: list[str],
    every_s: float,
    first_s: float | None,
    limits: ImageLimits,
) -> Sequence[str] | Iterator[InputPhotograph]:
    """List the files, or the frames of one video."""
    from vehanchor.imagery.sources.files import find_images
    from vehanchor_flight.video import is_video, sample_video

    if not any(is_video(name) for name in inputs):
        if first_s is not None:
            raise InvalidParameterError("--first is about a video: leave it out for photographs")
        return find_images(inputs)
    if len(inputs) > 1:
        raise InvalidParameterError("a video is a flight of its own: give it alone")
    return sample_video(inputs[0], every_s, limits, first_s=first_s)


def _write(record: FlightEstimate, out: Path | None, table: Path | None) -> None:
    """Write the record and the table that the caller wants, and name them."""
    from vehanchor.batch.table import write_table

    if out is not None:
        write_record(out, record)
    if table is not None:
        rows = [_row(record, photograph) for photograph in record.photographs]
        write_table(table, [row.flat() for row in rows])
    print_written(path for path in (out, table) if path is not None)


def _row(record: FlightEstimate, photograph: FlightPhotograph) -> BatchRow:
    """Make the row of ``vehanchor batch`` with the scale of the flight."""
    from vehanchor.batch.row import BatchRow
    from vehanchor_flight.project import estimate_in_flight

    if photograph.own is None:
        return BatchRow(
            photograph=photograph.photograph,
            error_code=photograph.error_code,
            error=photograph.error,
        )
    estimate = estimate_in_flight(record, photograph)
    return BatchRow(photograph=photograph.photograph, estimate=estimate)


def _print_record(record: FlightEstimate) -> None:
    """Print the facts of the flight, and a line for each photograph if their scales differ."""
    paths = [photograph.photograph for photograph in record.photographs]
    folder, relative_paths = under_one_folder(paths)
    short_names = dict(zip(paths, relative_paths, strict=True))
    title = count(len(record.photographs), "photograph")
    if folder:
        title += f" in {folder}"
    print_facts(title, _facts(record, short_names))
    if not record.same_scale:
        _print_photographs(record.photographs, short_names)
    print_warnings(record.warnings)


def _facts(record: FlightEstimate, short_names: Mapping[str, str]) -> list[tuple[str, str]]:
    """List what holds for the whole flight, with headings."""
    facts = []
    if record.same_scale:
        facts.append(("scale of all", scale_text(record)))
        if record.pixels_per_meter is not None:
            facts.append(("pixels per metre", significant(record.pixels_per_meter, 4)))
    status_text = STATUS_TEXTS[record.status]
    facts.append(("confidence", f"{record.confidence:.2f}   {status_text}"))
    facts.append(("vehicles", str(record.n_vehicles)))
    rulers = _rulers_text(record)
    if rulers:
        facts.append(("rulers", rulers))
    if not record.same_scale:
        facts.append(("linked", _components_text(record)))
        n_dropped = sum(link.dropped is not None for link in record.links)
        n_used = len(record.links) - n_dropped
        facts.append(("overlaps", f"{n_used} used, {n_dropped} dropped"))
    sizes = _sortie_sizes(record)
    if len(sizes) > 1:
        sizes_text = " and ".join(str(size) for size in sizes)
        facts.append(("sorties", f"{sizes_text} photographs, by camera and time"))
    for remedy, names in _names_by_remedy(record.photographs, short_names).items():
        facts.append(("not usable", f"{first_names(names)}. {remedy}"))
    return facts


def _sortie_sizes(record: FlightEstimate) -> list[int]:
    """Count the photographs of each sortie, in the order of the photographs."""
    numbers = [photograph.sortie for photograph in record.photographs]
    sizes = Counter(number for number in numbers if number is not None)
    return list(sizes.values())


def _rulers_text(record: FlightEstimate) -> str:
    """Name the rulers of the largest component with their chances; empty without any."""
    largest = record.components[0].pooled
    rulers = [ruler for ruler in largest.rulers if ruler.sets_scale]
    if not rulers:
        return ""
    text = ", ".join(f"{ruler.kind} {ruler.p_right:.2f}" for ruler in rulers)
    if len(record.components) > 1:
        text += " in the largest component"
    return text


def _components_text(record: FlightEstimate) -> str:
    """State the number of the components and their sizes."""
    n_components = len(record.components)
    if n_components == 1:
        return "all of them"
    shown = record.components[:_MAX_SIZES]
    sizes = ", ".join(str(component.n_photographs) for component in shown)
    if n_components > _MAX_SIZES:
        sizes += ", ..."
    return f"{n_components} components of {sizes} photographs"


def _names_by_remedy(
    photographs: Sequence[FlightPhotograph],
    short_names: Mapping[str, str],
) -> dict[str, list[str]]:
    """Group the photographs without a usable scale by their problem and its remedy."""
    names: dict[str, list[str]] = {}
    for photograph in photographs:
        remedy = photograph.advice
        if photograph.error is not None:
            remedy = f"Not readable: {photograph.error}"
        if remedy is not None:
            names_of_remedy = names.setdefault(remedy, [])
            names_of_remedy.append(short_names[photograph.photograph])
    return names


def _print_photographs(
    photographs: Sequence[FlightPhotograph],
    short_names: Mapping[str, str],
) -> None:
    """Print a table with a line for each photograph."""
    columns = {
        "photograph": "file",
        "m/px": "number",
        "95 % if right": "number",
        "conf.": "number",
        "ruler": "file",
        "status": "word",
        "reason": "word",
    }
    rows = [_cells(photograph, short_names) for photograph in photographs]
    print_rows(columns, rows)


def _cells(photograph: FlightPhotograph, short_names: Mapping[str, str]) -> tuple[str, ...]:
    """Make the cells of a photograph's line; "-" for what is unknown."""
    gsd, interval = scale_cells(photograph)
    confidence = "-"
    if photograph.confidence is not None:
        confidence = f"{photograph.confidence:.2f}"
    return (
        short_names[photograph.photograph],
        gsd,
        interval,
        confidence,
        _support_text(photograph, short_names),
        photograph.status,
        _reason_word(photograph),
    )


def _reason_word(photograph: FlightPhotograph) -> str:
    """Return why a scale is not usable in one word; the sentences stand above the table."""
    if photograph.status == "error":
        return "unreadable"
    return photograph.reason or ""


def _support_text(photograph: FlightPhotograph, short_names: Mapping[str, str]) -> str:
    """Name the first ruler behind a scale, and the photograph where it was measured."""
    if not photograph.supported_by:
        return "-"
    first = photograph.supported_by[0]
    if first.photograph == photograph.photograph:
        return f"own {first.ruler}"
    name = short_names[first.photograph]
    return f"{first.ruler} of {name}"
