"""Measurement of many objects and lines that a table names, such as the roofs of a town."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.errors import PromptError, VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.area import analyse_objects
from vehanchor.measure.distance import analyse_paths, read_path
from vehanchor.rulers.image_table import read_image_table
from vehanchor.segmentation.prompt import read_prompt

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence

    from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor.options import ScaleOptions
    from vehanchor.records import AreaMeasurement, DistanceMeasurement
    from vehanchor.segmentation.segmenter import Segmenter

Kind: TypeAlias = Literal["box", "point", "line"]

_NEEDED = ("file", "x1", "y1")
_OPTIONAL = ("x2", "y2", "kind", "name")
_KINDS: tuple[Kind, ...] = ("box", "point", "line")
_SIZES = (
    *("area_m2", "area_ci95_low_m2", "area_ci95_high_m2", "length_m", "width_m", "perimeter_m"),
    *("distance_m", "distance_ci95_low_m", "distance_ci95_high_m", "gsd_m_per_px"),
)
_SCORES = ("scale_confidence", "mask_score")
TARGET_COLUMNS: dict[str, type] = {
    **dict.fromkeys(("file", "name", "kind"), str),
    **dict.fromkeys(("x1", "y1", "x2", "y2"), float),
    "status": str,
    **dict.fromkeys((*_SIZES, *_SCORES), float),
    **dict.fromkeys(("warnings", "error_code", "error"), str),
}
"""Columns of the table of results and the types of their values, in order."""


@dataclass(frozen=True)
class Target:
    """Object or line to measure, in the coordinates of the options.

    Attributes:
        file: the image, as the table names it.
        name: the caller's name of the target; may be empty.
        kind: box around an object, point on it, or line.
        numbers: x1, y1 of a point; x1, y1, x2, y2 of a box or line.
    """

    file: str
    name: str
    kind: Kind
    numbers: tuple[float, ...]


class TargetRow(NamedTuple):
    """Result for one target: a record, or an error.

    Attributes:
        target: what was measured.
        record: the measurement; None with an error.
        ground: position of the image on the ground; None without a georeference.
        error: why there is no record.
    """

    target: Target
    record: AreaMeasurement | DistanceMeasurement | None = None
    ground: Ground | None = None
    error: VehAnchorError | None = None

    def flat(self) -> dict[str, Any]:
        """Give the values by column."""
        given = (*self.target.numbers, None, None)[:4]
        values = dict.fromkeys(TARGET_COLUMNS) | dict(
            zip(("x1", "y1", "x2", "y2"), given, strict=True)
        )
        values |= {"file": self.target.file, "name": self.target.name, "kind": self.target.kind}
        if self.record is not None:
            values |= {
                name: getattr(self.record, name, None) for name in ("status", *_SIZES, *_SCORES)
            }
            values["warnings"] = " ".join(each.code for each in self.record.warnings)
        if self.error is not None:
            values |= {"error_code": self.error.code, "error": str(self.error)}
        return values

    def feature(self) -> dict[str, Any] | None:
        """Make the GeoJSON feature of the outline or line, in pixels; None without one."""
        geometry = None if self.record is None else self.record.__geo_interface__
        if geometry is None or not geometry["coordinates"]:
            return None
        hidden = ("x1", "y1", "x2", "y2", "error_code", "error")
        properties = {name: value for name, value in self.flat().items() if name not in hidden}
        return {"type": "Feature", "geometry": geometry, "properties": properties}


def read_targets(path: str | os.PathLike[str]) -> dict[str, tuple[Target, ...]]:
    """Read a CSV with the columns ``file``, ``x1``, ``y1``, ``x2``, ``y2``, and optionally ``kind`` and ``name``.

    The kind is ``box``, ``line`` or ``point``; an empty one is a point without ``x2``, else a box.

    Args:
        path: path of the table. Files are relative to the table.

    Returns:
        The targets of each image, by its absolute path.

    Raises:
        PromptError: the table cannot be read, or a row is invalid; the message names the row.
    """
    return read_image_table(
        path, "targets", needed=_NEEDED, read_row=_target, error=PromptError, optional=_OPTIONAL
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
        image: its path.
        targets: of this image.
        detector: finds the vehicles.
        segmenter: finds the objects.
        options: all options of the method.

    Returns:
        One row per target, in order. An error of the image goes into each row.
    """
    try:
        with open_raster(image, options.reading) as raster:
            search = cache(lambda: analyse_raster(detector, raster, options))
            return [
                _measure(raster, target, segmenter, lambda *_: search(), options)
                for target in targets
            ]
    except VehAnchorError as error:
        return [TargetRow(target, error=error) for target in targets]


def _target(row: Mapping[str, str | None]) -> Target:
    numbers = tuple(
        float(row.get(name) or "")
        for name in ("x1", "y1", "x2", "y2")
        if row.get(name) or name[1] == "1"
    )
    kind = row.get("kind") or ("point" if len(numbers) == 2 else "box")
    if kind not in _KINDS:
        raise PromptError(f"kind is {kind!r}: use {', '.join(_KINDS)}")
    if len(numbers) != (2 if kind == "point" else 4):
        raise PromptError(
            f"a {kind} has {len(numbers)} numbers: a point has x1, y1; a box or line has x1, "
            "y1, x2, y2"
        )
    return Target(row["file"] or "", row.get("name") or "", kind, numbers)


def _measure(
    raster: Raster, target: Target, segmenter: Segmenter, scale: ScaleInput, options: ScaleOptions
) -> TargetRow:
    """Measure a target; an error in its place is its row's alone."""
    given: Any = target.numbers
    found: AreaAnalysis | DistanceAnalysis
    try:
        if target.kind == "line":
            (found,) = analyse_paths(
                raster, [read_path([given[:2], given[2:]])], scale=scale, options=options
            )
        else:
            prompt = (
                read_prompt(given, None) if target.kind == "box" else read_prompt(None, [given])
            )
            (found,) = analyse_objects(
                raster, [prompt], segmenter=segmenter, scale=scale, options=options
            )
    except PromptError as error:
        return TargetRow(target, error=error)
    return TargetRow(target, found.measurement, raster.ground)
