"""Target of a measurement: a box around an object, or points on it and beside it."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from vehanchor.options.option import Number
from vehanchor_server.base_model import FrozenModel

MAX_POINTS = 32  # more than anyone clicks
MAX_TARGETS = 16  # per call

_FORMS = (
    'give either box or points: {"box": {"x_min": 10, "y_min": 20, "x_max": 90, "y_max": 80}} or '
    '{"points": [{"x": 50, "y": 40}]}'
)


class Box(FrozenModel):
    """An upright box around the object."""

    x_min: Number
    y_min: Number
    x_max: Number
    y_max: Number

    @property
    def corners(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Upper left and lower right corner."""
        return (self.x_min, self.y_min), (self.x_max, self.y_max)


class Point(FrozenModel):
    """A point on the object, or beside it to exclude its surroundings."""

    x: Number
    y: Number
    label: Literal["include", "exclude"] = Field(
        default="include", description="exclude: beside the object."
    )


class Target(FrozenModel):
    """One object: a box, preferably, or points if a box is ambiguous."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    box: Box | None = Field(default=None, description="Tightly around the whole object.")
    points: tuple[Point, ...] | None = Field(
        default=None, min_length=1, max_length=MAX_POINTS, description="At least one on the object."
    )

    @property
    def coordinates(self) -> list[tuple[float, float]]:
        """Corners of the box, or points."""
        if self.box is not None:
            return list(self.box.corners)
        return [(point.x, point.y) for point in self.points or ()]

    @model_validator(mode="before")
    @classmethod
    def _has_one_form(cls, value: Any) -> Any:
        if isinstance(value, Target):
            return value
        forms = []
        if isinstance(value, dict):
            forms = [name for name in ("box", "points") if value.get(name) is not None]
        if len(forms) != 1:
            raise PydanticCustomError("target_form", _FORMS)
        return value
