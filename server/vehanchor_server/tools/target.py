"""Target of a measurement: a box around an object, points on it and beside it, or its outline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from vehanchor.options.option import Number
from vehanchor_server.base_model import FrozenModel

MAX_POINTS = 32  # more than anyone clicks
MAX_TARGETS = 16  # per call
MIN_POLYGON_NUMBERS = 6
MAX_POLYGON_NUMBERS = 400  # 16 polygons stay within the limits of the request guard

_FORMS = (
    'give either box, points or polygon: {"box": {"x_min": 10, "y_min": 20, "x_max": 90, "y_max": '
    '80}}, {"points": [{"x": 50, "y": 40}]} or {"polygon": [10, 20, 90, 20, 90, 80]}'
)
_FORM_NAMES = ("box", "points", "polygon")
_MUST_FIT_FORMS = 'give {"diameter_m": 12} or {"length_m": 12, "width_m": 5}'
Metres: TypeAlias = Annotated[Number, Field(gt=0)]


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
    """One object: a box, preferably; points if a box is ambiguous; a polygon if you have it."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 1})

    box: Box | None = Field(default=None, description="Tightly around the whole object.")
    points: tuple[Point, ...] | None = Field(
        default=None, min_length=1, max_length=MAX_POINTS, description="At least one on the object."
    )
    polygon: tuple[Number, ...] | None = Field(
        default=None,
        min_length=MIN_POLYGON_NUMBERS,
        max_length=MAX_POLYGON_NUMBERS,
        description="Its outline, if known: x1, y1, x2, y2, ... No model refines it.",
    )

    @property
    def coordinates(self) -> list[tuple[float, float]]:
        """Corners of the box or polygon, or points."""
        if self.box is not None:
            return list(self.box.corners)
        if self.polygon is not None:
            x = self.polygon[::2]
            y = self.polygon[1::2]
            # An odd number is refused with the prompt.
            return list(zip(x, y, strict=False))
        return [(point.x, point.y) for point in self.points or ()]

    @model_validator(mode="before")
    @classmethod
    def _has_one_form(cls, value: Any) -> Any:
        if isinstance(value, Target):
            return value
        forms = []
        if isinstance(value, dict):
            forms = [name for name in _FORM_NAMES if value.get(name) is not None]
        if len(forms) != 1:
            raise PydanticCustomError("target_form", _FORMS)
        return value


class MustFit(FrozenModel):
    """A circle, or a rectangle."""

    model_config = ConfigDict(json_schema_extra={"minProperties": 1, "maxProperties": 2})

    diameter_m: Metres | None = None
    length_m: Metres | None = None
    width_m: Metres | None = None

    @model_validator(mode="after")
    def _is_one_shape(self) -> MustFit:
        is_rectangle = self.length_m is not None and self.width_m is not None
        is_partial = self.length_m is not None or self.width_m is not None
        if (self.diameter_m is None) != is_rectangle or (is_partial and not is_rectangle):
            raise PydanticCustomError("must_fit_form", _MUST_FIT_FORMS)
        return self


@dataclass(frozen=True)
class Objects:
    """Subject of a call of ``measure_area``.

    Attributes:
        targets: the objects.
        must_fit: shape that must fit into each; None for none.
    """

    targets: tuple[Target, ...]
    must_fit: MustFit | None = None
