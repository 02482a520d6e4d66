"""``vehanchor flight rescale``: the size of a reconstruction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.terminal import (
    NOT_OK,
    STATUS_TEXTS,
    AsJson,
    Strict,
    exit_strictly,
    first_names,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    print_written,
    printable,
    resumable,
    work_progress,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.storage.atomic import beside, check_output_path, write_record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_flight.reconstruction.model import Reconstruction
    from vehanchor_flight.records import ModelPhotograph, ModelRuler, ModelScale

_NOT_USED = {
    "outlier": "its own factor and that of the model exclude each other",
    "unclear": "its own factor is known only within a factor of 2",
    "nothing": "nothing of known size was found",
}
"""Why photographs do not carry the factor, by their status."""
_FILES_PANEL = "Files to write"
_METADATA_OPTIONS = ("metadata", "height_m", "height_basis", "height_tolerance_m", "focal_35mm")


@scale_command(without=("frame", "coordinates", "known_lengths", *_METADATA_OPTIONS))
def rescale(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL",
            help="Project of OpenDroneMap or OpenSfM, its reconstruction.json, or a folder of "
            "COLMAP (text or binary).",
            show_default=False,
        ),
    ],
    images: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Photographs of the model. Default: near its files."),
    ] = None,
    lines: Annotated[
        Path | None,
        typer.Option(
            "--known-lengths",
            metavar="LINES.csv",
            help="Lines of known length: photograph, x1, y1, x2, y2, metres; paths are relative to "
            "the table.",
        ),
    ] = None,
    project: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Model in metres, in its format.", rich_help_panel=_FILES_PANEL
        ),
    ] = None,
    geo: Annotated[
        Path | None,
        typer.Option(
            metavar="geo.txt",
            help="Camera positions in metres for OpenDroneMap.",
            rich_help_panel=_FILES_PANEL,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="SCALE.json",
            help="Record; the same command resumes an interrupted run.",
            rich_help_panel=_FILES_PANEL,
        ),
    ] = None,
    as_json: AsJson = False,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Give a reconstruction its size in metres. Files in metres need a usable size."""
    from vehanchor_flight.verbs import rescale as estimate_factor

    journal = None
    if out is not None:
        out = check_output_path(out, (".json",), kind="a record")
        journal = beside(out, ".journal")
    model = _model(source, project, geo)
    with work_progress("images") as progress, resumable(journal):
        record = estimate_factor(
            model,
            engine=chosen.engine(progress=progress),
            images=images,
            known_lengths_table=lines,
            journal=journal,
        )
    written = _write_in_metres(model, record, project=project, geo=geo)
    if out is not None:
        write_record(out, record)
        written.append(out)
    if as_json:
        print_json(record.model_dump(mode="json"))
    else:
        _print_record(record, source)
    print_written(written)
    if record.status != "ok" and (project or geo):
        typer.echo("no file in metres was written: the size is not usable", err=True)
        raise typer.Exit(NOT_OK)
    exit_strictly(strict, [record.status])


def _model(source: str, project: Path | None, geo: Path | None) -> Reconstruction:
    """Check that the files can be written, and read the model."""
    from vehanchor_flight.reconstruction.files import check_project_path, read_model

    if geo is not None:
        check_output_path(geo)
    if project is not None:
        check_project_path(project)
    model = read_model(source)
    if geo is not None and model.origin is None:
        raise InvalidParameterError(
            "--geo needs a model with a position on Earth (reference_lla of OpenSfM)"
        )
    return model


def _write_in_metres(
    model: Reconstruction,
    record: ModelScale,
    project: Path | None,
    geo: Path | None,
) -> list[Path]:
    """Write the files in metres of a usable size; return their paths."""
    from vehanchor_flight.reconstruction.files import write_geo, write_rescaled

    if record.status != "ok" or record.factor is None:
        return []
    written = []
    if geo is not None:
        write_geo(geo, model, record.factor)
        written.append(geo)
    if project is not None:
        written.append(write_rescaled(model, project, record.factor))
    return written


def _print_record(record: ModelScale, source: str) -> None:
    """Print the factor, the photographs that carry it, and errors."""
    print_facts(source, _facts(record))
    used = [photograph for photograph in record.photographs if photograph.status == "used"]
    if used:
        _print_photographs(used)
    for photograph in record.photographs:
        if photograph.status == "error":
            sentence = f"not measured: {photograph.photograph}: {photograph.error}"
            typer.echo(printable(sentence), err=True)
    print_warnings(record.warnings)


def _facts(record: ModelScale) -> list[tuple[str, str]]:
    """List what holds for the whole model, with headings."""
    facts = [("verdict", record.verdict)]
    if record.factor is not None:
        facts.append(("factor", _factor_text(record)))
    status_text = STATUS_TEXTS[record.status]
    facts.append(("confidence", f"{record.confidence:.2f}   {status_text}"))
    if record.advice is not None:
        facts.append(("not usable", record.advice))
    for ruler in record.rulers:
        factor = _factor_text(ruler)
        text = f"{factor}, from {ruler.n}, right with a chance of {ruler.p_right:.2f}"
        facts.append((ruler.label, text))
    if record.photographs:
        n_used = sum(photograph.status == "used" for photograph in record.photographs)
        facts.append(("photographs", f"{record.n_photographs}, used for the factor: {n_used}"))
    for status, sentence in _NOT_USED.items():
        names = [each.photograph for each in record.photographs if each.status == status]
        if names:
            facts.append(("not used", f"{first_names(names)}: {sentence}"))
    return facts


def _factor_text(record: ModelScale | ModelRuler | ModelPhotograph) -> str:
    interval = f"{record.factor_ci95_low:.4g} to {record.factor_ci95_high:.4g}"
    return f"{record.factor:.4g}   (95 %: {interval})"


def _print_photographs(photographs: Sequence[ModelPhotograph]) -> None:
    """Print a table with a line for each photograph."""
    columns = {
        "photograph": "file",
        "factor": "number",
        "95 %": "number",
        "cars": "number",
        "rulers": "text",
    }
    rows = [_cells(photograph) for photograph in photographs]
    print_rows(columns, rows)


def _cells(photograph: ModelPhotograph) -> tuple[str, ...]:
    """Make the cells of a photograph's line."""
    low = photograph.factor_ci95_low
    high = photograph.factor_ci95_high
    return (
        photograph.photograph,
        f"{photograph.factor:.4g}",
        f"{low:.3g} to {high:.3g}",
        str(photograph.n_vehicles),
        ", ".join(photograph.rulers),
    )
