"""``vehanchor flight rescale``: the size of a reconstruction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.terminal import (
    NOT_OK,
    STATUS_TEXTS,
    Strict,
    exit_strictly,
    print_facts,
    print_json,
    print_rows,
    print_warnings,
    printable,
    resumable,
    work_progress,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.storage.atomic import check_output_path, write_record

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_flight.reconstruction.model import Reconstruction
    from vehanchor_flight.records import ModelPhotograph, ModelRuler, ModelScale

_FILES = "Files to write"
_METADATA = ("metadata", "height_m", "height_basis", "height_tolerance_m", "focal_35mm")


@scale_command(without=("frame", "coordinates", "known_lengths", *_METADATA))
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
            help="Lines of known length in the photographs: file, x1, y1, x2, y2, metres; files "
            "are relative to the "
            "table.",
        ),
    ] = None,
    project: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Model in metres, in its format.", rich_help_panel=_FILES
        ),
    ] = None,
    geo: Annotated[
        Path | None,
        typer.Option(
            metavar="geo.txt",
            help="Camera positions in metres for OpenDroneMap.",
            rich_help_panel=_FILES,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="SCALE.json",
            help="Record; the same command resumes an interrupted run.",
            rich_help_panel=_FILES,
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object and nothing else.")
    ] = False,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Give a reconstruction its size in metres. Files in metres need a usable size."""
    from vehanchor_flight.verbs import rescale as rescaled

    journal = out and check_output_path(out, (".json",), kind="a record").with_name(
        out.name + ".journal"
    )
    model = _model(source, project, geo)
    with work_progress("images") as progress, resumable(journal):
        engine = chosen.engine(progress=progress)
        record = rescaled(
            model, engine=engine, images=images, known_lengths_table=lines, journal=journal
        )
    written = _write_in_metres(model, record, project=project, geo=geo)
    if out is not None:
        write_record(out, record)
        written.append(out)
    _tell(record, source, written, as_json=as_json)
    if record.status != "ok" and (project or geo):
        typer.echo("no file in metres was written: the size is not usable", err=True)
        raise typer.Exit(NOT_OK)
    exit_strictly(strict, [record.status])


def _model(source: str, project: Path | None, geo: Path | None) -> Reconstruction:
    """Read the model, after checks that the files to write are possible."""
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
    model: Reconstruction, record: ModelScale, project: Path | None, geo: Path | None
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


def _tell(record: ModelScale, source: str, written: Sequence[Path], *, as_json: bool) -> None:
    if as_json:
        print_json(record.model_dump(mode="json"))
        return
    facts = [("verdict", record.verdict)]
    if record.factor is not None:
        facts.append(("factor", _interval(record)))
    facts.append(("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}"))
    if record.reason is not None:
        facts.append(("reason", record.reason))
    for ruler in record.rulers:
        facts.append((ruler.label, f"{_interval(ruler)}, n {ruler.n}, right: {ruler.p_right:.2f}"))
    used = [each for each in record.photographs if each.status == "used"]
    if record.photographs:
        facts.append(("photographs", f"{record.n_photographs}, used for the factor: {len(used)}"))
    outliers = (each for each in record.photographs if each.status == "outlier")
    facts += [
        ("outlier", f"{each.photograph}: {', '.join(each.rulers)} {_interval(each)}")
        for each in outliers
    ]
    facts += [("written", str(path)) for path in written]
    print_facts(source, facts)
    if used:
        _print_photographs(used)
    for each in record.photographs:
        if each.status == "error":
            typer.echo(
                printable(f"not measured[{each.error_code}]: {each.photograph}: {each.error}"),
                err=True,
            )
    print_warnings(record.warnings)


def _interval(each: ModelScale | ModelRuler | ModelPhotograph) -> str:
    return f"{each.factor:.4g}   (95 %: {each.factor_ci95_low:.4g} to {each.factor_ci95_high:.4g})"


def _print_photographs(used: Sequence[ModelPhotograph]) -> None:
    columns = {
        "photograph": "text",
        **dict.fromkeys(("factor", "95 %", "cars"), "number"),
        "rulers": "text",
    }
    print_rows(
        columns,
        [
            (
                each.photograph,
                f"{each.factor:.4g}",
                f"{each.factor_ci95_low:.3g} to {each.factor_ci95_high:.3g}",
                str(each.n_vehicles),
                ", ".join(each.rulers),
            )
            for each in used
        ],
    )
