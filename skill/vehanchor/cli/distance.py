"""``vehanchor distance``: length of a line in metres."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.cli_options import ParsedOptions, Photograph, scale_command
from vehanchor.cli.measurement import show_measurement
from vehanchor.cli.multi_value import parse_point
from vehanchor.cli.scale_option import (
    GivenGsd,
    ObjectHeight,
    ScaleFile,
    SearchAnyway,
    read_scale,
)
from vehanchor.cli.terminal import AsJson, Strict
from vehanchor.records.text import with_interval

if TYPE_CHECKING:
    from vehanchor.analysis.measurement_analysis import DistanceAnalysis
    from vehanchor.cli.terminal import Facts
    from vehanchor.models.runtime import Progress
    from vehanchor.records import DistanceMeasurement


@scale_command()
def distance(
    image: Photograph,
    point: Annotated[
        list[str] | None,
        typer.Option(metavar="X Y", help="A point of the line, pixels; give two or more in order."),
    ] = None,
    gsd: GivenGsd = None,
    scale: ScaleFile = None,
    object_height: ObjectHeight = None,
    search: SearchAnyway = False,
    line: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.geojson",
            help="Write the line with its length as GeoJSON: degrees if georeferenced, else "
            "pixels.",
        ),
    ] = None,
    as_json: AsJson = False,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.png",
            help="Write the line and its surroundings with length, vehicles and scale bar.",
        ),
    ] = None,
    strict: Strict = False,
    *,
    chosen: ParsedOptions,
) -> None:
    """Measure the distance (metres) between two points, or along a line through several.

    The scale comes from the file if it is georeferenced, else from cars in the image, unless you
    give one.
    """

    def analyse(progress: Progress) -> DistanceAnalysis:
        path = [parse_point("--point", text) for text in point or ()]
        known_scale = read_scale(scale, image)
        return chosen.engine().analyse_distance(
            image,
            path,
            gsd_m_per_px=gsd,
            scale=known_scale,
            object_height_m=object_height,
            file_scale=not search,
            progress=progress,
        )

    files = {"line": line, "overlay": overlay}
    show_measurement(image, analyse, facts=_facts, files=files, as_json=as_json, strict=strict)


def _facts(record: DistanceMeasurement) -> Facts:
    """List the facts of the record without its scale."""
    distance = with_interval(
        record.distance_m,
        record.distance_ci95_low_m,
        high=record.distance_ci95_high_m,
        unit="m",
        missing="none: there is no scale",
    )
    line = f"{len(record.path)} points, {record.length_px:.1f} px"
    return [("distance", distance), ("line", line)]
