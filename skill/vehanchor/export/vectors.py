"""Vector files of boxes, outlines and lines, for maps and for training detectors.

Coordinates are on the ground for a georeferenced file, else in pixels of the image, y down, and the files say so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor.errors import OutputError
from vehanchor.export.formats import VECTOR_FORMATS, check_vector_path
from vehanchor.export.layer import Layer
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vehanchor.analysis.measured import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.imagery.metadata.georeference import Ground


def write_boxes(path: str | Path, analysis: ScaleAnalysis) -> Path:
    """Write the vehicles of an analysis; the suffix chooses the format of ``VECTOR_FORMATS``.

    Args:
        path: path of the file.
        analysis: the analysis of an image.

    Returns:
        The path.

    Raises:
        OutputError: as ``check_vector_path``, or the file cannot be written.
    """
    columns = {"number": int, "kept": bool, "score": float, "length_px": float}
    layer = Layer("vehicles", analysis.__geo_interface__["features"], columns, "Polygon", "vehicle", analysis.ground)
    return _write(check_vector_path(path), [layer])


def write_measured(path: str | Path, analysis: AreaAnalysis | DistanceAnalysis) -> Path:
    """Write the measured outline or line with its size; the suffix chooses the format.

    Args:
        path: as in ``write_boxes``; DOTA's text has the smallest rotated rectangle of an outline, and no lines.
        analysis: the analysis of a measurement.

    Returns:
        The path.

    Raises:
        OutputError: as ``check_vector_path``, or the file cannot be written.
    """
    feature = analysis.__geo_interface__
    geometry = feature["geometry"]
    is_line = geometry["type"] == "LineString"
    columns = {name: str if name == "status" else float for name in feature["properties"]}
    features = [feature] if geometry["coordinates"] else []
    layer = Layer("lines" if is_line else "outlines", features, columns, geometry["type"], "object", analysis.ground)
    return _write(check_vector_path(path, lines=is_line), [layer])


def write_targets(
    path: str | Path, placed: Sequence[tuple[dict[str, Any], Ground | None]], columns: Mapping[str, type]
) -> Path:
    """Write the outlines and lines of many images; the suffix chooses the format.

    Args:
        path: path of the file.
        placed: features in pixels, each with the position of its image on the ground.
        columns: names and types of values; those that no feature has are left out.

    Raises:
        OutputError: as ``check_vector_path``; or only some images are georeferenced.
    """
    if len({ground is None for _, ground in placed}) > 1:
        raise OutputError("some images are georeferenced and others are not: write one file for each kind")
    layers = []
    for name, kind in (("outlines", "MultiPolygon"), ("lines", "LineString")):
        own = [(feature, ground) for feature, ground in placed if feature["geometry"]["type"] == kind]
        found = {key for feature, _ in own for key, value in feature["properties"].items() if value is not None}
        used = {key: type_ for key, type_ in columns.items() if key in found}
        layers += [Layer(name, [feature], used, kind, "object", ground) for feature, ground in own]
    return _write(check_vector_path(path, lines=True), layers)


def _write(target: Path, layers: Sequence[Layer]) -> Path:
    with whole_file(target) as partial:
        VECTOR_FORMATS[target.suffix.lower()].write(partial, layers)
    return target
