"""Registered rulers, one line each: kind in records, and path of the class.

Records, JSON schemas and tables list the kinds; ``vehanchor.rulers.active`` imports the classes.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Annotated, Any, TypeAlias

from pydantic import Field

RULERS: dict[str, str] = {
    "vehicles": "vehanchor.rulers.vehicles:Vehicles",
    "scene_scale": "vehanchor.rulers.scene_scale:SceneScale",
    "camera": "vehanchor.rulers.camera:Camera",
    "known_length": "vehanchor.rulers.known_length:KnownLengths",
    "height": "vehanchor.rulers.height:GivenHeight",
    "stated_scale": "vehanchor.rulers.stated_scale:StatedScale",
    "courts": "vehanchor.rulers.courts:Courts",
    "positions": "vehanchor.rulers.positions:Positions",
}
"""Class of each ruler by its kind, as ``module:Class``; imported on first use."""

# Installed packages add rulers; they cannot replace one of ours.
for _entry_point in sorted(entry_points(group="vehanchor.rulers"), key=lambda point: point.name):
    RULERS.setdefault(_entry_point.name, _entry_point.value)


def _add_kinds(schema: dict[str, Any]) -> None:
    schema["enum"] = list(RULERS)


RulerKind: TypeAlias = Annotated[str, Field(json_schema_extra=_add_kinds)]
"""Kind of a ruler: its name in options, records and tables."""
