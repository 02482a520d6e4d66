"""Options of measurements beside the option groups: a known scale, and the height of an object."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from vehanchor.options.option import Limits, Option
from vehanchor.scale.defaults import LARGEST_GSD_M_PER_PX, LEAST_GSD_M_PER_PX

GSD_M_PER_PX = Limits(LEAST_GSD_M_PER_PX, LARGEST_GSD_M_PER_PX)
OBJECT_HEIGHT_M = Limits(0, 1000, unit="m")

GSD = Option("Known metres per pixel of the full image; skips the search.", metavar="M/PX", flag="gsd")
OBJECT_HEIGHT = Option(
    "Height of the object above ground, metres, such as a roof; needs the camera height or focal length.",
    metavar="M",
    flag="object-height",
)

ObjectHeight: TypeAlias = Annotated[Annotated[float, OBJECT_HEIGHT_M] | None, OBJECT_HEIGHT]
