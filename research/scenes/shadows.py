"""Shadows: outlines of vehicles, trees and roofs swept along the light, in metres."""

from __future__ import annotations

import math
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.sprites import CROWN_SPAN, Sun
from research.scenes.world import PlacedVehicle, Roof, Tree

Points: TypeAlias = NDArray[np.float64]
"""Points x, y ``[n, 2]``."""


def swept(points: Points, offset: tuple[float, float]) -> Points:
    """Compute the convex hull of a convex outline and its shadow."""
    both = np.vstack([points, points + offset]).astype(np.float32)
    return cast("Points", cv2.convexHull(both).reshape(-1, 2).astype(np.float64))


def roof_shadows(roof: Roof, sun: Sun) -> list[Points]:
    """Compute the convex hull of each part's walls, ridge and their shadows."""
    hulls = []
    for part in roof.parts:
        corners = roof.corners(part)
        outline = [corners, corners + sun.shadow(roof.eaves)]
        if roof.style != "flat":
            x0, y0, x1, y1 = part
            half = min(x1 - x0, y1 - y0) / 2
            inset = half if roof.style == "hip" else 0.0
            if x1 - x0 >= y1 - y0:
                middle_y = (y0 + y1) / 2
                ridge = [(x0 + inset, middle_y), (x1 - inset, middle_y)]
            else:
                middle_x = (x0 + x1) / 2
                ridge = [(middle_x, y0 + inset), (middle_x, y1 - inset)]
            outline.append(roof.frame.points(ridge) + sun.shadow(roof.eaves + roof.pitch * half))
        hull = (
            cv2.convexHull(np.vstack(outline).astype(np.float32)).reshape(-1, 2).astype(np.float64)
        )
        hulls.append(cast("Points", hull))
    return hulls


def tree_reach(tree: Tree, reach: Points) -> Points:
    """Compute two corners of the box around a crown and its shadow.

    Args:
        tree: the tree.
        reach: shadow of 1 m of height.
    """
    radius = tree.radius * CROWN_SPAN
    centre = np.array([tree.x, tree.y])
    ends = np.array([centre, centre + tree.height * reach])
    return cast("Points", np.vstack([ends - radius, ends + radius]))


def vehicle_corners(vehicle: PlacedVehicle, grow: float = 1.0) -> Points:
    """Compute a vehicle's corners [4,2]; length and width grow by ``grow - 1`` times the length."""
    cos = math.cos(vehicle.angle)
    sin = math.sin(vehicle.angle)
    margin = (grow - 1) * vehicle.model.length_m
    along = np.array([cos, sin]) * (vehicle.model.length_m + margin) / 2
    across = np.array([-sin, cos]) * (vehicle.model.width_m + margin) / 2
    centre = np.array([vehicle.x, vehicle.y])
    return cast(
        "Points",
        np.array(
            [
                centre + along - across,
                centre + along + across,
                centre - along + across,
                centre - along - across,
            ]
        ),
    )


def vehicle_outline(vehicle: PlacedVehicle) -> Points:
    """Compute an octagon slightly inside the body, the base of its shadow."""
    corners = vehicle_corners(vehicle)
    inner = []
    for index in range(4):
        corner = corners[index]
        before = corners[index - 1]
        after = corners[(index + 1) % 4]
        for other in (before, after):
            span = other - corner
            inner.append(corner + span * (0.28 / float(np.hypot(*span))))
    return np.array(inner)


def vehicle_reach(vehicle: PlacedVehicle, reach: Points) -> Points:
    """Compute points [8,2] around a vehicle and its shadow.

    Args:
        vehicle: the vehicle.
        reach: shadow of 1 m of height.
    """
    corners = vehicle_corners(vehicle)
    return cast("Points", np.vstack([corners, corners + 3.5 * reach]))
