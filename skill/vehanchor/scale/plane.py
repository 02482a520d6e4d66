"""The ground as a plane under a pinhole camera: a scale for every pixel instead of one for all.

With ``d = (x / f, y / f, 1)`` the ray of a pixel counted from the image's centre, ``n`` the unit vector straight down
in the camera's frame and ``h`` the height above the ground, a pixel is ``sqrt(h^2 f^-2 (n d)^-3)`` metres wide and high
at the mean, and its ray meets the ground at ``h d / (n d)``. The camera's roll turns the direction in which it looks
aside within the image. Straight down is the special case: ``n = (0, 0, 1)`` and one scale, ``h / f``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import TooObliqueError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

LEAST_DESCENT = 0.174  # cosine of 80 degrees: nearer to the horizon a degree changes the scale by a sixth and more
_ROWS = 512  # of a mask at once


@dataclass(frozen=True)
class GroundPlane:
    """A plane under a camera, its scale that of the image's centre.

    Attributes:
        gsd_m_per_px: metres per pixel at the centre: root of the area of ground that a pixel there shows.
        tilt_deg: angle between the camera's axis and straight down, 0 to 90.
        focal_px: focal length, pixels of the image.
        width_px: of the image.
        height_px: of the image.
        roll_deg: by which the direction in which it looks aside is turned clockwise from the image's upper side.
    """

    gsd_m_per_px: float
    tilt_deg: float
    focal_px: float
    width_px: int
    height_px: int
    roll_deg: float = 0.0

    @property
    def down(self) -> NDArray[np.float64]:
        """``[3]`` unit vector straight down: to the right, to the lower side, along the axis."""
        tilt, roll = math.radians(self.tilt_deg), math.radians(self.roll_deg)
        aside = math.sin(tilt)
        return np.array([-aside * math.sin(roll), aside * math.cos(roll), math.cos(tilt)])

    @property
    def height_m(self) -> float:
        """Height of the camera above the plane, metres."""
        return self.gsd_m_per_px * self.focal_px * float(math.cos(math.radians(self.tilt_deg)) ** 1.5)

    def check(self) -> None:
        """Refuse a plane that the image sees up to its horizon, or nearly so.

        Raises:
            TooObliqueError: the lowest ray of a corner comes down at less than ten degrees.
        """
        if float(self._descents(self._corners).min()) < LEAST_DESCENT:
            raise TooObliqueError(
                f"the camera looked {self.tilt_deg:.0f} degrees away from straight down: the horizon is in sight, or "
                "nearly so, and no scale holds there. Crop the image to the ground that is near"
            )

    def ground(self, points: ArrayLike) -> NDArray[np.float64]:
        """Where pixels lie on the ground.

        Args:
            points: ``[n, 2]`` x, y in pixels of the image.

        Returns:
            ``[n, 3]`` metres, in the camera's frame: only differences mean anything.

        Raises:
            TooObliqueError: one lies above the horizon, or just below it.
        """
        rays = self._rays(points)
        return np.asarray(self.height_m * rays / self._checked(rays @ self.down)[:, None])

    def from_above(self, points: ArrayLike) -> NDArray[np.float64]:
        """Where pixels would lie in a view from straight above, of the scale of the image's centre.

        Args:
            points: ``[n, 2]`` x, y in pixels of the image.

        Returns:
            ``[n, 2]`` pixels from the image's centre; what lies to the right of it there stays to its right.

        Raises:
            TooObliqueError: as ``ground``.
        """
        centre = [[self.width_px / 2, self.height_px / 2]]
        from_centre = (self.ground(points) - self.ground(centre)) / self.gsd_m_per_px
        down = self.down
        right = np.array([1.0, 0.0, 0.0]) - down[0] * down
        right /= np.linalg.norm(right)
        return np.asarray(from_centre @ np.column_stack([right, np.cross(down, right)]))

    def gsd_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Metres per pixel at places of the image.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n]`` root of the area of ground that a pixel there shows.

        Raises:
            TooObliqueError: as ``ground``.
        """
        descents = self._checked(self._rays(points) @ self.down)
        return np.asarray(self.height_m / self.focal_px * descents**-1.5)

    @property
    def gsd_range(self) -> tuple[float, float]:
        """The least and the largest metres per pixel in the image; they are at corners.

        Raises:
            TooObliqueError: as ``ground``.
        """
        found = self.gsd_at(self._corners)
        return float(found.min()), float(found.max())

    def area(self, mask: NDArray[np.bool_], left: int = 0, top: int = 0) -> float:
        """Area of ground under a mask, square metres: the sum of what each of its pixels shows.

        Args:
            mask: ``[h, w]`` bool.
            left: column of the image at which it begins.
            top: row at which it begins.

        Raises:
            TooObliqueError: as ``ground``.
        """
        total = 0.0
        for start in range(0, len(mask), _ROWS):
            rows, columns = np.nonzero(mask[start : start + _ROWS])
            if len(rows):
                points = np.column_stack([columns + left + 0.5, rows + start + top + 0.5])
                total += float((self.gsd_at(points) ** 2).sum())
        return total

    def length(self, first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
        """Length of lines on the ground, metres.

        Args:
            first: ``[n, 2]`` one end of each, pixels.
            second: ``[n, 2]`` the other.

        Raises:
            TooObliqueError: as ``ground``.
        """
        return np.asarray(np.linalg.norm(self.ground(first) - self.ground(second), axis=1))

    def raised(self, height_m: float) -> GroundPlane:
        """The parallel plane that lies higher: what stands on the ground is nearer to the camera, and larger.

        Args:
            height_m: above the ground; a roof's, say.

        Raises:
            TooObliqueError: it lies above the camera.
        """
        left = 1 - height_m / self.height_m
        if left <= 0:
            raise TooObliqueError(
                f"an object {height_m:g} m above the ground lies above the camera, which is {self.height_m:.0f} m up: "
                "give a lower height"
            )
        return GroundPlane(
            self.gsd_m_per_px * left, self.tilt_deg, self.focal_px, self.width_px, self.height_px, self.roll_deg
        )

    @property
    def _corners(self) -> NDArray[np.float64]:
        right, bottom = float(self.width_px), float(self.height_px)
        return np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])

    def _rays(self, points: ArrayLike) -> NDArray[np.float64]:
        places = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        middle = np.array([self.width_px / 2, self.height_px / 2])
        return np.column_stack([(places - middle) / self.focal_px, np.ones(len(places))])

    def _descents(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Cosine of each ray's angle from straight down."""
        rays = self._rays(points)
        return np.asarray(rays @ self.down / np.linalg.norm(rays, axis=1))

    def _checked(self, descents: NDArray[np.float64]) -> NDArray[np.float64]:
        if len(descents) and float(descents.min()) < LEAST_DESCENT:
            raise TooObliqueError(
                f"with a camera {self.tilt_deg:.0f} degrees away from straight down a place lies above the horizon, or "
                "just below it, where no scale holds: crop the image to the ground that is near"
            )
        return descents
