"""How a caller points at one object: a box around it, or points on it and beside it."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Field, Tag

from vehanchor_server.frozen import FrozenModel

__all__ = ["MAX_POINTS", "AnyTarget", "BoxTarget", "PointsTarget", "TargetArgument"]

MAX_POINTS = 32  # more than anyone clicks


class Box(FrozenModel):
    """An upright box around the object."""

    x_min: float = Field(description="Left side, pixels from the left edge.")
    y_min: float = Field(description="Upper side, pixels from the upper edge.")
    x_max: float = Field(description="Right side.")
    y_max: float = Field(description="Lower side.")


class Point(FrozenModel):
    """A place on the object, or one beside it that must stay out."""

    x: float = Field(description="Pixels from the left edge.")
    y: float = Field(description="Pixels from the upper edge.")
    label: Literal["include", "exclude"] = Field(
        default="include", description="include: on the object. exclude: beside it, where the mask must not go."
    )


class BoxTarget(FrozenModel):
    """The object in a box: the surest way."""

    box: Box = Field(description="Drawn tightly around the whole object.")


class PointsTarget(FrozenModel):
    """The object at a point, for one that a box does not tell from its neighbours."""

    points: list[Point] = Field(min_length=1, max_length=MAX_POINTS, description="At least one on the object.")


def _form(value: Any) -> str | None:
    """Which of the two a value is meant as; None where it is neither or both."""
    named = [name for name in ("box", "points") if (name in value if isinstance(value, dict) else hasattr(value, name))]
    return named[0] if len(named) == 1 else None


AnyTarget: TypeAlias = BoxTarget | PointsTarget

TargetArgument = Annotated[
    Annotated[BoxTarget, Tag("box")] | Annotated[PointsTarget, Tag("points")],
    Discriminator(
        _form,
        custom_error_type="target_form",
        custom_error_message='give box or points, one of the two: {"box": {"x_min": 10, "y_min": 20, "x_max": 90, '
        '"y_max": 80}} or {"points": [{"x": 50, "y": 40}]}',
    ),
]
"""The ``target`` of ``measure_area``: exactly one form, by the schema already."""
