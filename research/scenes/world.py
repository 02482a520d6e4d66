"""Primitives of a scene in metres: the layout creates them, the renderer draws them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from research.scenes.fleet import VehicleModel
from research.scenes.truth import Category, CourtKind

Points: TypeAlias = NDArray[np.float64]
"""Points x, y ``[n, 2]``."""

Rgb = tuple[int, int, int]
Rect = tuple[float, float, float, float]
"""x0, y0, x1, y1 in a local frame."""


def corners_of(rect: Rect) -> list[tuple[float, float]]:
    """List the four corners of a rectangle, in order around it."""
    x0, y0, x1, y1 = rect
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


class Material(IntEnum):
    """Materials, which decide how a surface's colour varies; the renderer holds the amplitudes."""

    PLAIN = 0
    ASPHALT = 1
    PAVING = 2
    PAINT = 3
    LAWN = 4
    MEADOW = 5
    SOIL = 6
    GRAVEL = 7
    WATER = 8
    COURT = 9
    CROP = 10


@dataclass(frozen=True)
class Frame:
    """Local coordinate system: its origin and the direction of its x axis in the image's frame."""

    x: float
    y: float
    angle: float

    def points(self, local: ArrayLike) -> Points:
        """Convert local coordinates [N,2] to the frame of the image."""
        xy = np.asarray(local, dtype=np.float64).reshape(-1, 2)
        cos = math.cos(self.angle)
        sin = math.sin(self.angle)
        placed = np.empty_like(xy)
        placed[:, 0] = self.x + cos * xy[:, 0] - sin * xy[:, 1]
        placed[:, 1] = self.y + sin * xy[:, 0] + cos * xy[:, 1]
        return placed

    def at(self, x: float, y: float, angle: float = 0.0) -> Frame:
        """Create a frame inside this one."""
        (origin,) = self.points([(x, y)])
        return Frame(float(origin[0]), float(origin[1]), self.angle + angle)


@dataclass(frozen=True, eq=False)
class Surface:
    """Flat polygon on the ground; later ones cover earlier ones."""

    points: Points
    rgb: Rgb
    material: Material


@dataclass(frozen=True, eq=False)
class Stain:
    """Polygon that darkens (level < 128) or lightens the ground."""

    points: Points
    level: int


@dataclass(frozen=True, eq=False)
class Box:
    """Low object with vertical sides: wall, shed, container, hedge, parasol, or a pole's shadow."""

    points: Points
    height: float
    rgb: Rgb
    leafy: bool = False


@dataclass(frozen=True)
class PlacedVehicle:
    """Vehicle with its position and direction."""

    model: VehicleModel
    x: float
    y: float
    angle: float


@dataclass(frozen=True, eq=False)
class PlacedCourt:
    """Court with its outline: ``[4, 2]`` corners, the first two at the ends of a long side."""

    kind: CourtKind
    corners: Points


@dataclass(frozen=True)
class Roof:
    """Roof over one or two rectangles (x0, y0, x1, y1 in its own frame)."""

    frame: Frame
    parts: tuple[Rect, ...]
    style: str
    """``gable``, ``hip`` or ``flat``."""
    pitch: float
    """Rise per metre."""
    eaves: float
    """Height of the eaves."""
    rgb: Rgb
    seed: int

    def corners(self, part: Rect) -> Points:
        """Compute the corners [4,2] of one of its rectangles in the frame of the image."""
        return self.frame.points(corners_of(part))


@dataclass(frozen=True)
class Tree:
    """Tree crown: its radius, its height above ground, and the number of its sprite (``look``)."""

    x: float
    y: float
    radius: float
    height: float
    rgb: Rgb
    look: int


@dataclass(frozen=True, eq=False)
class Target:
    """Masked object: the union of one or more polygons."""

    category: Category
    polygons: tuple[Points, ...]
    area: float


@dataclass(eq=False)
class World:
    """All primitives of a scene."""

    surfaces: list[Surface] = field(default_factory=list)
    stains: list[Stain] = field(default_factory=list)
    boxes: list[Box] = field(default_factory=list)
    vehicles: list[PlacedVehicle] = field(default_factory=list)
    roofs: list[Roof] = field(default_factory=list)
    trees: list[Tree] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    courts: list[PlacedCourt] = field(default_factory=list)
