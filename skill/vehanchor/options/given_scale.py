"""Options of measurements beside the option groups: a known scale, and the height of an object."""

from __future__ import annotations

from vehanchor.options.option import Limits, Option
from vehanchor.scale.defaults import LARGEST_GSD_M_PER_PX, LEAST_GSD_M_PER_PX

GSD_M_PER_PX = Limits(LEAST_GSD_M_PER_PX, LARGEST_GSD_M_PER_PX)
OBJECT_HEIGHT_M = Limits(0, 1000)

GSD = Option(
    "Known metres per pixel of the full image; skips the search.",
    GSD_M_PER_PX,
    metavar="M/PX",
    flag="gsd",
    keyword="gsd_m_per_px",
)
OBJECT_HEIGHT = Option(
    "Height of the object above ground, metres, such as a roof; needs the camera height or focal length.",
    OBJECT_HEIGHT_M,
    metavar="M",
    flag="object-height",
    keyword="object_height_m",
)
