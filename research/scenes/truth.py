"""Ground truth of a rendered scene, and its files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias, cast, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from vehanchor.errors import InvalidParameterError

Corners: TypeAlias = NDArray[np.float64]
"""Corners x, y ``[4, 2]``."""

Picture: TypeAlias = NDArray[np.uint8]
"""RGB picture ``[h, w, 3]``."""

VehicleKind = Literal["small-vehicle", "large-vehicle"]
FleetKind = Literal["passenger", "mixed"]
Layout = Literal["urban", "parking", "countryside", "sports"]
Category = Literal["swimming-pool", "building", "sports-court", "field", "parking-lot"]
CourtKind = Literal["tennis", "basketball_fiba", "basketball_nba", "basketball_ncaa"]
CATEGORIES: tuple[Category, ...] = get_args(Category)

_SUFFIXES = (".png", ".jpg", ".jpeg")
_JPEG_QUALITY = 95


@dataclass(frozen=True)
class SceneVehicle:
    """Drawn vehicle, bumper to bumper, without its shadow.

    Pixel coordinates are continuous: the image spans [0, width] x [0, height], and the first
    pixel's centre is (0.5, 0.5).
    """

    kind: VehicleKind
    x_px: float
    y_px: float
    length_px: float
    width_px: float
    angle_rad: float
    """Direction of the long axis towards the front, clockwise from +x (y points down)."""
    difficult: bool = False
    """Whether the image's edge cuts it, or a tree hides more than 40 % of it."""
    body: str = field(default="", repr=False)
    """Body; empty if unknown."""

    def corners(self) -> Corners:
        """Compute the corners [4,2] in pixels: front left, front right, rear right, rear left."""
        cos = np.cos(self.angle_rad)
        sin = np.sin(self.angle_rad)
        along = np.array([cos, sin]) * self.length_px / 2
        across = np.array([-sin, cos]) * self.width_px / 2
        centre = np.array([self.x_px, self.y_px])
        offsets = np.array([along - across, along + across, -along + across, -along - across])
        return cast("Corners", centre + offsets)


@dataclass(frozen=True)
class SceneObject:
    """Masked object and its areas."""

    category: Category
    instance: int
    """Its value in the category's mask; 1, 2, ..."""
    area_m2: float
    """Visible area: the mask's pixels times the squared GSD."""
    full_area_m2: float
    """Area of the whole outline, including parts outside the image or below a tree."""


@dataclass(frozen=True, eq=False)
class SceneCourt:
    """Painted court of exact size.

    Attributes:
        kind: game and rules.
        corners: ``[4, 2]`` corners of its outline, outside the lines, in pixels; the first two
            bound a long side.
        hidden_share: 0..1, share of its area in the image below trees.
        cut: whether the image's edge cuts it.
    """

    kind: CourtKind
    corners: Corners
    hidden_share: float
    cut: bool


@dataclass(frozen=True, eq=False)
class Scene:
    """Rendered image and its ground truth.

    Attributes:
        image: [H,W,3] RGB.
        gsd_m_per_px: size of a pixel on the ground.
        vehicles: drawn vehicles whose centre is inside the image.
        masks: category -> [H,W] instance numbers, 0 for the background. Pools are water and
            buildings are roofs, both without parts below trees. Courts are the whole surfaced
            enclosure. Fields and parking lots are the whole ground, including objects on it.
        objects: objects in the masks, with areas.
        seed: seed of the scene.
        parameters: the other arguments of ``render_scene``, and values drawn from the seed.
        courts: courts whose centre is inside the image.
    """

    image: Picture
    gsd_m_per_px: float
    vehicles: tuple[SceneVehicle, ...]
    masks: Mapping[Category, NDArray[np.uint16]]
    objects: tuple[SceneObject, ...]
    seed: int
    parameters: Mapping[str, float | int | str | None]
    courts: tuple[SceneCourt, ...] = ()

    def dota_text(self) -> str:
        """Format the vehicles as DOTA text.

        After a ``gsd:`` line, each line has four corners, the class, and 1 if difficult.
        """
        lines = [f"gsd:{self.gsd_m_per_px:.10g}"]
        for vehicle in self.vehicles:
            corners = " ".join(f"{value:.3f}" for value in vehicle.corners().ravel())
            lines.append(f"{corners} {vehicle.kind} {int(vehicle.difficult)}")
        return "\n".join(lines) + "\n"

    def write(self, path: Path) -> list[Path]:
        """Write the image and its ground truth.

        Args:
            path: path of the image, ending in ``.png``, ``.jpg`` or ``.jpeg``, in an existing
                folder.

        Returns:
            The written files: the image, ``<stem>.json`` (scale, size, parameters, areas),
            ``<stem>.txt`` (vehicles in DOTA format) and one 16-bit ``<stem>_<category>.png`` per
            category.

        Raises:
            InvalidParameterError: the path has another suffix.
            OSError: a file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in _SUFFIXES:
            raise InvalidParameterError(
                f"the path of a scene must end in {', '.join(_SUFFIXES)}, got {path.name!r}"
            )
        written = [_write_image(path, np.ascontiguousarray(self.image[:, :, ::-1]))]
        record = {
            "gsd_m_per_px": self.gsd_m_per_px,
            "width_px": self.image.shape[1],
            "height_px": self.image.shape[0],
            "seed": self.seed,
            "parameters": dict(self.parameters),
            "objects": [
                {
                    "category": item.category,
                    "instance": item.instance,
                    "area_m2": item.area_m2,
                    "full_area_m2": item.full_area_m2,
                }
                for item in self.objects
            ],
        }
        facts = path.with_suffix(".json")
        facts.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
        labels = path.with_suffix(".txt")
        labels.write_text(self.dota_text(), encoding="utf-8")
        written += [facts, labels]
        for category, mask in self.masks.items():
            written.append(_write_image(path.with_name(f"{path.stem}_{category}.png"), mask))
        return written


def _write_image(path: Path, image: Picture | NDArray[np.uint16]) -> Path:
    """Encode in memory and let Python write, because OpenCV cannot open every path."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if path.suffix.lower() != ".png" else []
    _, encoded = cv2.imencode(path.suffix.lower(), image, quality)
    path.write_bytes(encoded.tobytes())
    return path
