"""``vehanchor flight rescale``: the size of a reconstruction or an orthophoto."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.terminal import (
    NOT_OK,
    STATUS_TEXTS,
    Strict,
    exit_on_error,
    exit_strictly,
    facts_table,
    image_progress,
    print_json,
    print_table,
    print_warnings,
    printable,
    resumable,
    tile_progress,
)
from vehanchor.errors import ImageNotFoundError, InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.table import Table

    from vehanchor_flight.reconstruction.model import Reconstruction
    from vehanchor_flight.records import ModelPhotograph, ModelScale

_FILES = "Files to write"
_METADATA = ("metadata", "height_m", "height_basis", "height_tolerance_m", "focal_35mm")


Folder: TypeAlias = Annotated[
    Path | None, typer.Option("--images", metavar="FOLDER", help="Photographs of the model. Default: near its files.")
]
Lines: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--known-lengths",
        metavar="LINES.csv",
        help="Lines of known length in the photographs: file, x1, y1, x2, y2, metres; files are relative to the table.",
    ),
]
Project: TypeAlias = Annotated[
    Path | None,
    typer.Option("--project", metavar="FOLDER", help="Model in metres, in its format.", rich_help_panel=_FILES),
]
Matrix: TypeAlias = Annotated[
    Path | None,
    typer.Option("--matrix", metavar="OUT.txt", help="Similarity as a 4 x 4 matrix.", rich_help_panel=_FILES),
]
Geo: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--geo", metavar="geo.txt", help="Camera positions in metres for OpenDroneMap.", rich_help_panel=_FILES
    ),
]
GeoTiff: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--geotiff", metavar="OUT.tif", help="Copy of an orthophoto, in local metres.", rich_help_panel=_FILES
    ),
]


@scale_command(without=("frame", "coordinates", *_METADATA))
def rescale(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL",
            help="Project of OpenDroneMap or OpenSfM, its reconstruction.json, a folder of COLMAP (text or binary), or "
            "an orthophoto.",
            show_default=False,
        ),
    ],
    images: Folder = None,
    lines: Lines = None,
    project: Project = None,
    matrix: Matrix = None,
    geo: Geo = None,
    geotiff: GeoTiff = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="SCALE.json",
            help="Write the record. After an interruption, the same command resumes the run.",
            rich_help_panel=_FILES,
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Give a reconstruction or an orthophoto its size in metres. Files in metres need a usable size."""
    with exit_on_error():
        from vehanchor_flight.io import check_output, write_record
        from vehanchor_flight.reconstruction.files import find_model

        journal = out and check_output(out, ".json").with_name(out.name + ".journal")
        for path in filter(None, (matrix, geo)):
            check_output(path)
        if not Path(source).suffix and not Path(source).exists():
            raise ImageNotFoundError(f"there is no folder {source!r}: name a reconstruction or an orthophoto")
        if find_model(source) is not None or Path(source).is_dir():
            _refuse({"--geotiff": geotiff}, "an orthophoto")
            record, write = _model(source, images, lines, chosen, (project, matrix, geo), journal)
        else:
            given = {"--project": project, "--matrix": matrix, "--geo": geo, "--images": images}
            _refuse(given, "a reconstruction")
            if lines is not None:
                raise InvalidParameterError("an orthophoto is one image: give each line with --known-length")
            record, write = _orthophoto(source, chosen, geotiff)
        usable = record.status == "ok"
        written = write(record) if usable else []
        if out is not None:
            write_record(out, record)
            written.append(out)
        _tell(record, source, written, as_json=as_json)
        if not usable and any((project, matrix, geo, geotiff)):
            typer.echo("no file in metres was written: the size is not usable", err=True)
            raise typer.Exit(NOT_OK)
        exit_strictly(strict, [record.status])


def _model(
    source: str,
    images: Path | None,
    lines: Path | None,
    chosen: ParsedOptions,
    out: Sequence[Path | None],
    journal: Path | None,
) -> tuple[ModelScale, Callable[[ModelScale], list[Path]]]:
    """Measure a reconstruction; return the record, and a function that writes its files."""
    from vehanchor_flight.reconstruction.files import check_project_path, images_of, read_model
    from vehanchor_flight.verbs import rescale as rescaled

    project, matrix, geo = out
    if chosen.values.get("known_lengths"):
        raise InvalidParameterError("a model has many photographs: give lines as a table with --known-lengths")
    if project is not None:
        check_project_path(project)
    model = read_model(source)
    if geo is not None and model.origin is None:
        raise InvalidParameterError("--geo needs a model with a position on Earth (reference_lla of OpenSfM)")
    folder = images or images_of(model)
    with image_progress() as progress, resumable(journal):
        engine = chosen.engine(progress=progress)
        record = rescaled(model, engine=engine, images=folder, known_lengths_table=lines, journal=journal)
    return record, lambda found: _write_model(model, found, project, matrix, geo)


def _write_model(
    model: Reconstruction, record: ModelScale, project: Path | None, matrix: Path | None, geo: Path | None
) -> list[Path]:
    from vehanchor_flight.reconstruction.files import write_geo, write_matrix, write_rescaled

    assert record.factor is not None
    written = [] if project is None else [write_rescaled(model, project, record.factor)]
    if matrix is not None:
        write_matrix(matrix, record.factor)
    if geo is not None:
        write_geo(geo, model, record.factor)
    return written + [path for path in (matrix, geo) if path is not None]


def _orthophoto(
    source: str, chosen: ParsedOptions, geotiff: Path | None
) -> tuple[ModelScale, Callable[[ModelScale], list[Path]]]:
    """Measure an orthophoto; return the record, and a function that writes its files."""
    from vehanchor.export.geotiff import check_copy_path, write_metric_copy
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.storage.atomic import check_apart
    from vehanchor_flight.reconstruction.estimate import orthophoto_scale

    if geotiff is not None:
        check_apart(check_copy_path(geotiff), source)
    with tile_progress(1, lines_on_terminal=False) as step:
        engine = chosen.engine(progress=step(0, source))
        record = orthophoto_scale(engine.estimate(source, metadata=False))

    def write(found: ModelScale) -> list[Path]:
        assert found.gsd_m_per_px is not None
        if geotiff is None:
            return []
        reading = engine.options.reading
        with open_raster(source, bands=reading.bands, limits=reading.limits) as raster:
            write_metric_copy(geotiff, raster, found.gsd_m_per_px)
        return [geotiff]

    return record, write


def _refuse(given: dict[str, Path | None], noun: str) -> None:
    for name, value in given.items():
        if value is not None:
            raise InvalidParameterError(f"{name} is for {noun}: leave it out")


def _tell(record: ModelScale, source: str, written: Sequence[Path], *, as_json: bool) -> None:
    if as_json:
        print_json(record.model_dump(mode="json"))
        return
    facts = [("verdict", record.verdict)]
    if record.factor is not None:
        facts.append(("factor", _interval(record.factor, record.factor_ci95_low, record.factor_ci95_high)))
    facts.append(("confidence", f"{record.confidence:.2f}   {STATUS_TEXTS[record.status]}"))
    if record.reason is not None:
        facts.append(("reason", record.reason))
    for ruler in record.rulers:
        part = f"right: {ruler.p_right:.2f}"
        stated = _interval(ruler.factor, ruler.factor_ci95_low, ruler.factor_ci95_high)
        facts.append((ruler.label, f"{stated}, n {ruler.n}, {part}"))
    used = [each for each in record.photographs if each.status == "used"]
    if record.photographs:
        facts.append(("photographs", f"{record.n_photographs}, {len(used)} of them carry the factor"))
    facts += [
        ("outlier", f"{each.photograph}: {_own(each)}") for each in record.photographs if each.status == "outlier"
    ]
    facts += [("written", str(path)) for path in written]
    print_table(facts_table(source, facts))
    if used:
        print_table(_photographs(used))
    for each in record.photographs:
        if each.status == "error":
            typer.echo(printable(f"not measured[{each.error_code}]: {each.photograph}: {each.error}"), err=True)
    print_warnings(record, "")


def _interval(factor: float, low: float | None, high: float | None) -> str:
    return f"{factor:.4g}" if low is None or high is None else f"{factor:.4g}   (95 %: {low:.4g} to {high:.4g})"


def _own(each: ModelPhotograph) -> str:
    if each.factor is None:
        return "-"
    return f"{', '.join(each.rulers)} {_interval(each.factor, each.factor_ci95_low, each.factor_ci95_high)}"


def _photographs(used: Sequence[ModelPhotograph]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("photograph", overflow="fold")
    for heading in ("factor", "95 %", "cars"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("rulers", overflow="fold")
    for each in used:
        low, high = each.factor_ci95_low, each.factor_ci95_high
        table.add_row(
            Text(printable(each.photograph)),
            f"{each.factor:.4g}",
            f"{low:.3g} to {high:.3g}",
            str(each.n_vehicles),
            ", ".join(each.rulers),
        )
    return table
