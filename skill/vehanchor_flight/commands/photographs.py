"""``vehanchor flight photographs``: scales of the photographs of one flight from their common evidence."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.cli.scale_option import KnownLengthsFile
from vehanchor.cli.terminal import (
    STATUS_TEXTS,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    resumable,
    under_one_folder,
    work_progress,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.records.text import NO_SCALE, count, significant, with_interval
from vehanchor.storage.atomic import check_output_path, write_record

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from vehanchor.batch.row import BatchRow
    from vehanchor.options import ImageLimits
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.records import FlightEstimate, FlightPhotograph

_MOST_SIZES = 12  # of components, in one line
_MOST_NAMED = 3  # photographs with one advice
_STATUSES = {"ok": "ok", "low_confidence": "low", "no_scale": "none", "error": "error"}


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
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
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
    known_lengths: KnownLengthsFile = None,
    every: Annotated[
        float, typer.Option(metavar="S", help="For a video: seconds between photographs.")
    ] = 2.0,
    *,
    chosen: ParsedOptions,
) -> None:
    """Estimate the scales of the photographs of one flight from their common evidence."""
    from vehanchor.batch.table import check_table_path, write_table
    from vehanchor_flight.verbs import estimate_flight

    out = out and check_output_path(out, (".json",), kind="a record")
    table = table and check_table_path(table)
    journal = (kept := out or table) and kept.with_name(kept.name + ".journal")
    images = _images(inputs, every, chosen.options().reading.limits)
    last = "pooling the evidence of" if same_scale else "linking"
    counted = isinstance(images, Sequence)  # the length of a video is unknown
    with work_progress("images") as tell, resumable(journal):
        record = estimate_flight(
            images,
            engine=chosen.engine(),
            same_scale=same_scale,
            known_lengths_table=known_lengths,
            journal=journal,
            progress=lambda done, n: tell(done, n, last if counted and done == n else "searching"),
        )
    if out is not None:
        write_record(out, record)
    if table is not None:
        write_table(table, (_row(record, each).flat() for each in record.photographs))
    _tell(record, as_json=as_json)


def _tell(record: FlightEstimate, *, as_json: bool) -> None:
    if as_json:
        print_json(record.model_dump(mode="json"))
        return
    folder, names = under_one_folder([each.photograph for each in record.photographs])
    where = f" in {folder}" if folder else ""
    short = {each.photograph: name for each, name in zip(record.photographs, names, strict=True)}
    print_facts(f"{count(len(record.photographs), 'photograph')}{where}", _facts(record, short))
    if not record.same_scale:
        _print_photographs(record.photographs, short)
    print_warnings(record.warnings)


def _row(record: FlightEstimate, photograph: FlightPhotograph) -> BatchRow:
    """Make the row of ``vehanchor batch`` with the scale of the flight."""
    from vehanchor.batch.row import BatchRow
    from vehanchor_flight.project import estimate_in_flight

    if photograph.own is None:
        return BatchRow(
            file=photograph.photograph, error_code=photograph.error_code, error=photograph.error
        )
    return BatchRow(file=photograph.photograph, estimate=estimate_in_flight(record, photograph))


def _images(
    inputs: list[str], every_s: float, limits: ImageLimits
) -> Sequence[str] | Iterator[InputPhotograph]:
    """List the files, or the frames of one video."""
    from vehanchor.imagery.sources.files import find_images
    from vehanchor_flight.video import is_video, sample_video

    if not any(is_video(each) for each in inputs):
        return find_images(inputs)
    if len(inputs) > 1:
        raise InvalidParameterError("a video is a flight of its own: give it alone")
    return sample_video(inputs[0], every_s, limits)


def _facts(record: FlightEstimate, short: Mapping[str, str]) -> list[tuple[str, str]]:
    facts = []
    if record.same_scale:
        low = record.gsd_ci95_low_m_per_px
        high = record.gsd_ci95_high_m_per_px
        facts.append(
            (
                "scale of all",
                with_interval(record.gsd_m_per_px, low, high=high, unit="m/px", missing=NO_SCALE),
            )
        )
    facts.append(("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}"))
    facts.append(("vehicles", str(record.n_vehicles)))
    if rulers := [each for each in record.components[0].pooled.rulers if each.sets_scale]:
        largest = " in the largest component" if len(record.components) > 1 else ""
        facts.append(
            ("rulers", ", ".join(f"{each.kind} {each.p_right:.2f}" for each in rulers) + largest)
        )
    if not record.same_scale:
        sizes = ", ".join(
            str(component.n_photographs) for component in record.components[:_MOST_SIZES]
        )
        sizes += ", ..." if len(record.components) > _MOST_SIZES else ""
        several = f"{len(record.components)} components of {sizes} photographs"
        facts.append(("linked", several if len(record.components) > 1 else "all of them"))
        n_dropped = sum(link.dropped is not None for link in record.links)
        facts.append(("overlaps", f"{len(record.links) - n_dropped} used, {n_dropped} dropped"))
    sorties = Counter(each.sortie for each in record.photographs if each.sortie is not None)
    if len(sorties) > 1:
        facts.append(
            (
                "sorties",
                f"{' and '.join(map(str, sorties.values()))} photographs, by camera and time",
            )
        )
    advice: dict[str, list[str]] = {}
    for each in record.photographs:
        remedy = each.advice if each.error is None else f"Not readable: {each.error}"
        if remedy is not None:
            advice.setdefault(remedy, []).append(short[each.photograph])
    facts += [("not usable", f"{_names(names)}. {remedy}") for remedy, names in advice.items()]
    return facts


def _names(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more


def _print_photographs(photographs: Sequence[FlightPhotograph], short: Mapping[str, str]) -> None:
    columns = {"photograph": "text", **dict.fromkeys(("m/px", "95 %", "conf."), "number")}
    print_rows(
        {**columns, "supported by": "text", "status": "word"},
        [_cells(each, short) for each in photographs],
    )


def _cells(each: FlightPhotograph, short: Mapping[str, str]) -> tuple[str, ...]:
    low = each.gsd_ci95_low_m_per_px
    high = each.gsd_ci95_high_m_per_px
    return (
        short[each.photograph],
        "-" if each.gsd_m_per_px is None else significant(each.gsd_m_per_px, 4),
        "-" if low is None or high is None else f"{significant(low)} to {significant(high)}",
        "-" if each.confidence is None else f"{each.confidence:.2f}",
        _support(each, short),
        _STATUSES[each.status],
    )


def _support(photograph: FlightPhotograph, short: Mapping[str, str]) -> str:
    if not photograph.supported_by:
        return "-"
    first = photograph.supported_by[0]
    if first.photograph == photograph.photograph:
        return f"its own {first.ruler}"
    return f"{first.ruler} of {short[first.photograph]}"
