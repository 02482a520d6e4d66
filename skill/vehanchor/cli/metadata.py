"""Camera metadata of a photograph for people, as ``estimate --details`` prints them."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vehanchor.cli.terminal import Facts
    from vehanchor.options import ScaleOptions

_UNITS = {"m": "m", "mm": "mm", "35mm": "mm, as of a 35 mm camera", "px": "px", "deg": "degrees"}
"""Units by the last part of a field's name."""


def metadata_facts(source: str, options: ScaleOptions) -> Facts:
    """List the metadata that were read, and those that the file lacks.

    Args:
        source: path of the photograph.
        options: how it is read.

    Raises:
        ImageError: the photograph cannot be read again.
    """
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.sources.opening import open_raster

    with open_raster(source, options.reading) as raster:
        camera = raster.camera
    if camera is None:
        return [("metadata", f"none in {source}")]
    facts = [("metadata", f"of {source}")]
    lacking = []
    defaults = CameraMetadata()
    for field in fields(camera):
        value = getattr(camera, field.name)
        name, unit = _name_and_unit(field.name)
        if value == getattr(defaults, field.name):
            lacking.append(name)
            continue
        text = f"{value:.10g}" if isinstance(value, float) else str(value)
        facts.append((name, f"{text} {unit}".rstrip()))
    if lacking:
        facts.append(("not in the file", ", ".join(lacking)))
    return facts


def _name_and_unit(field: str) -> tuple[str, str]:
    """Split the name of a field into words and its unit."""
    words, _, last = field.rpartition("_")
    unit = _UNITS.get(last, "")
    if unit:
        return words.replace("_", " ") or last, unit
    return field.replace("_", " "), ""
