"""Measurement of many objects and lines that a table names, such as the roofs of a town."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.errors import PromptError, VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.area import analyse_objects
from vehanchor.measure.distance import analyse_paths, read_path
from vehanchor.measure.shape_file import read_shape_file
from vehanchor.measure.shapes import read_polygon
from vehanchor.records.contradiction import contradiction_text
from vehanchor.rulers.image_table import PHOTOGRAPH, read_image_table
from vehanchor.segmentation.prompt import read_prompt

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence

    from vehanchor.analysis.measurement_analysis import DistanceAnalysis
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor.measure.shapes import CallerShape
    from vehanchor.options import ScaleOptions
    from vehanchor.options.reading import Place
    from vehanchor.records import AreaMeasurement, DistanceMeasurement
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmenter

Kind: TypeAlias = Literal["box", "point", "line", "polygon", "shapes"]

_REQUIRED_COLUMNS = (PHOTOGRAPH,)
_OPTIONAL_COLUMNS = ("x1", "y1", "x2", "y2", "kind", "name", "polygon", "shapes")
_N_NUMBERS: dict[Kind, int] = {"box": 4, "point": 2, "line": 4}
_COORDINATES = ("x1", "y1", "x2", "y2")
_AREA_FIELDS = (
    "area_m2",
    "area_ci95_low_m2",
    "area_ci95_high_m2",
    "length_m",
    "width_m",
    "perimeter_m",
)
_DISTANCE_FIELDS = ("distance_m", "distance_ci95_low_m", "distance_ci95_high_m")
# Fields that the results take from a record; a record without a field leaves its cell empty.
_NUMBER_FIELDS = (
    *_AREA_FIELDS,
    *_DISTANCE_FIELDS,
    "gsd_m_per_px",
    "georeference_gsd_m_per_px",
    "scale_confidence",
    "mask_score",
)
TARGET_COLUMNS: dict[str, type] = {
    "photograph": str,
    "name": str,
    "kind": str,
    **dict.fromkeys(_COORDINATES, float),
    "status": str,
    **dict.fromkeys(_NUMBER_FIELDS, float),
    "scale_source": str,
    "contradiction": str,
    "warnings": str,
    "error_code": str,
    "error": str,
}
"""Columns of the table of results and the types of their values, in order."""


@dataclass(frozen=True)
class Target:
    """Object or line to measure, in the coordinates of the options.

    Attributes:
        file: the image, as the table names it.
        name: the caller's name of the target; may be empty.
        kind: box around an object, point on it, line, polygon, or file of shapes.
        numbers: x1, y1 of a point; x1, y1, x2, y2 of a box or line; those of all corners of a
            polygon; none for a file of shapes.
        shapes: path of the file of shapes; empty for the other kinds.
    """

    file: str
    name: str
    kind: Kind
    numbers: tuple[float, ...] = ()
    shapes: str = ""


class TargetRow(NamedTuple):
    """Result for one target: a record, or an error.

    Attributes:
        target: the object or line.
        record: the measurement; None with an error.
        ground: position of the image on the ground; None without a georeference.
        error: reason for a missing record.
    """

    target: Target
    record: AreaMeasurement | DistanceMeasurement | None = None
    ground: Ground | None = None
    error: VehAnchorError | None = None

    def flat(self) -> dict[str, Any]:
        """Return the values by column."""
        target = self.target
        values: dict[str, Any] = dict.fromkeys(TARGET_COLUMNS)
        values["photograph"] = target.file
        values["name"] = target.name
        values["kind"] = target.kind
        if target.kind in _N_NUMBERS:
            # A point has no x2 and y2.
            values.update(zip(_COORDINATES, target.numbers, strict=False))
        if self.record is not None:
            for name in ("status", *_NUMBER_FIELDS):
                values[name] = getattr(self.record, name, None)
            values["scale_source"] = self.record.scale_source
            values["contradiction"] = contradiction_text(self.record) or None
            codes = [notice.code for notice in self.record.warnings]
            values["warnings"] = " ".join(codes)
        if self.error is not None:
            values["error_code"] = self.error.code
            values["error"] = str(self.error)
        return values

    def feature(self) -> dict[str, Any] | None:
        """Make the GeoJSON feature of the outline or line, in pixels; None without one."""
        if self.record is None:
            return None
        geometry = self.record.__geo_interface__
        if geometry is None or not geometry["coordinates"]:
            return None
        properties = self.flat()
        for hidden in (*_COORDINATES, "error_code", "error"):
            del properties[hidden]
        return {"type": "Feature", "geometry": geometry, "properties": properties}


def read_targets(path: str | os.PathLike[str]) -> dict[str, tuple[Target, ...]]:
    """Read a CSV of targets.

    The columns are ``file``, and ``x1``, ``y1``, ``x2``, ``y2``, ``polygon``, ``shapes``, ``kind``
    and ``name`` as far as the rows need them. ``polygon`` has the numbers of all corners, and
    ``shapes`` a file of shapes (COCO JSON, GeoJSON, PNG of ids), relative to the table, each of
    which becomes a target. The kind is ``box``, ``line`` or ``point``. A row without a kind is a
    point if it has no ``x2`` and ``y2``, else a box.

    Args:
        path: path of the table. Files are relative to the table.

    Returns:
        The targets of each image, by its absolute path.

    Raises:
        PromptError: the table cannot be read, or a row is invalid; the message names the row.
    """
    return read_image_table(
        path,
        "targets",
        needed=_REQUIRED_COLUMNS,
        read_row=partial(_read_target, Path(path).parent),
        error=PromptError,
        optional=_OPTIONAL_COLUMNS,
    )


def measure_targets(
    image: str,
    targets: Sequence[Target],
    detector: Detector,
    segmenter: Segmenter,
    options: ScaleOptions,
) -> list[TargetRow]:
    """Measure all targets of an image with one search.

    Args:
        image: path of the image.
        targets: targets in this image.
        detector: detects the vehicles.
        segmenter: segments the objects.
        options: all options of the method.

    Returns:
        One row per target, in order. An error of the image goes into each row.
    """
    try:
        with open_raster(image, options.reading) as raster:
            # Only the first target without a known scale searches the image.
            search = cache(lambda: analyse_raster(detector, raster, options))

            def find_scale(_raster: Raster, _options: ScaleOptions) -> ScaleAnalysis:
                return search()

            rows: list[TargetRow] = []
            for target in targets:
                rows += _measure_target(
                    raster, target, segmenter, scale=find_scale, options=options
                )
            return rows
    except VehAnchorError as error:
        return [TargetRow(target, error=error) for target in targets]


def _read_target(folder: Path, row: Mapping[str, str | None]) -> Target:
    """Read a row of a table in a folder.

    Raises:
        PromptError: a number or the kind is invalid, or the numbers do not fit the kind.
    """
    if row.get("polygon") or row.get("shapes"):
        return _read_own_shape(folder, row)
    columns = ["x1", "y1"]
    # A point has no x2 and y2.
    columns += [column for column in ("x2", "y2") if row.get(column)]
    numbers = [_read_number(row, column) for column in columns]
    kind = row.get("kind")
    if not kind:
        kind = "point" if len(numbers) == 2 else "box"
    if kind not in _N_NUMBERS:
        raise PromptError(
            f"kind is {kind!r}: use {', '.join(_N_NUMBERS)}, or the column polygon or shapes"
        )
    if len(numbers) != _N_NUMBERS[kind]:
        raise PromptError(
            f"a {kind} has {len(numbers)} numbers: a point has x1, y1; a box or line has x1, y1, "
            "x2, y2"
        )
    file = row[PHOTOGRAPH] or ""
    name = row.get("name") or ""
    return Target(file, name, kind=kind, numbers=tuple(numbers))


def _read_own_shape(folder: Path, row: Mapping[str, str | None]) -> Target:
    """Read a row with a polygon or a file of shapes."""
    filled = [column for column in ("polygon", "shapes", *_COORDINATES) if row.get(column)]
    if len(filled) > 1:
        raise PromptError(f"{' and '.join(filled)} are given: use one of them")
    (kind,) = filled
    stated_kind = row.get("kind") or kind
    if stated_kind != kind:
        raise PromptError(f"kind is {stated_kind!r} beside a {kind}: leave it empty")
    file = row[PHOTOGRAPH] or ""
    name = row.get("name") or ""
    if kind == "shapes":
        path = folder / (row["shapes"] or "")
        return Target(file, name, kind="shapes", shapes=str(path))
    text = row["polygon"] or ""
    try:
        numbers = tuple(float(number) for number in text.replace(",", " ").split())
    except ValueError:
        raise PromptError(f"polygon is {text!r}: use x1 y1 x2 y2 and so on") from None
    read_polygon(numbers)
    return Target(file, name, kind="polygon", numbers=numbers)


def _read_number(row: Mapping[str, str | None], column: str) -> float:
    text = row.get(column) or ""
    try:
        return float(text)
    except ValueError:
        raise PromptError(f"{column} is {text!r}: use a number") from None


def _measure_target(
    raster: Raster,
    target: Target,
    segmenter: Segmenter,
    *,
    scale: ScaleInput,
    options: ScaleOptions,
) -> list[TargetRow]:
    """Measure a target, or all shapes of its file; an invalid one concerns only its own row."""
    analyses: tuple[AreaAnalysis | DistanceAnalysis, ...]
    try:
        if target.kind == "line":
            path = _target_path(target)
            analyses = analyse_paths(raster, [path], scale=scale, options=options)
        else:
            subjects = _target_subjects(target, raster, options)
            analyses = analyse_objects(
                raster, subjects, segmenter=segmenter, scale=scale, options=options
            )
    except PromptError as error:
        return [TargetRow(target, error=error)]
    rows = []
    for analysis in analyses:
        measured = target
        if target.kind == "shapes" and isinstance(analysis, AreaAnalysis):
            name = f"{target.name} {analysis.name}".strip()
            measured = replace(target, name=name)
        rows.append(TargetRow(measured, analysis.measurement, raster.ground))
    return rows


def _target_subjects(
    target: Target, raster: Raster, options: ScaleOptions
) -> Sequence[Prompt | CallerShape]:
    """Read what names the object of a target, or its shapes."""
    if target.kind == "shapes":
        return read_shape_file(target.shapes, raster.source, limits=options.reading.limits)
    if target.kind == "polygon":
        return [read_polygon(target.numbers)]
    return [_target_prompt(target)]


def _target_path(target: Target) -> tuple[Place, ...]:
    x1, y1, x2, y2 = target.numbers
    return read_path([(x1, y1), (x2, y2)])


def _target_prompt(target: Target) -> Prompt:
    if target.kind == "box":
        x1, y1, x2, y2 = target.numbers
        return read_prompt((x1, y1, x2, y2), None)
    x, y = target.numbers
    return read_prompt(None, [(x, y)])
