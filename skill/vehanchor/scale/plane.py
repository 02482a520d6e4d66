"""Ground plane under a pinhole camera: one scale for every pixel.

Let ``d = (x / f, y / f, 1)`` be the ray of a pixel at (x, y) from the image's centre, ``n`` the
unit vector straight down in the camera's frame, and ``h`` the height above the ground. The mean GSD
of the pixel is ``sqrt(h^2 f^-2 (n d)^-3)``, and its ray meets the ground at ``h d / (n d)``. The
roll is the direction of the tilt in the image. At nadir ``n = (0, 0, 1)``, and the only scale is
``h / f``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vehanchor.errors import TooObliqueError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Vector: TypeAlias = NDArray[np.float64]
    """One point or direction."""

    Points: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` pixels, or ``[n, 3]`` metres in the camera's frame."""

    Lengths: TypeAlias = NDArray[np.float64]
    """``[n]`` lengths or scales."""

# Cosine of 80 degrees. Closer to the horizon, one degree changes the scale by a sixth or more.
MIN_DESCENT = 0.174
# Rows of a mask per block, which bounds the memory.
_ROWS = 512


@dataclass(frozen=True)
class GroundPlane:
    """Ground plane with the scale at the image's centre.

    Attributes:
        gsd_m_per_px: GSD at the centre: square root of the ground area of a pixel there.
        tilt_deg: angle between the camera's axis and straight down, 0 to 90.
        focal_px: focal length, pixels of the image.
        width_px: width of the image.
        height_px: height of the image.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
    """

    gsd_m_per_px: float
    tilt_deg: float
    focal_px: float
    width_px: int
    height_px: int
    roll_deg: float = 0.0

    @property
    def down(self) -> Vector:
        """Unit vector ``[3]`` straight down, in the camera's frame.

        The components are to the right, to the lower side, and along the axis.
        """
        tilt = math.radians(self.tilt_deg)
        roll = math.radians(self.roll_deg)
        sine = math.sin(tilt)
        right = -sine * math.sin(roll)
        lower = sine * math.cos(roll)
        return np.array([right, lower, math.cos(tilt)])

    @property
    def height_m(self) -> float:
        """Height of the camera above the plane, metres."""
        # The GSD of the module's equation at the centre, where n d = cos(tilt), solved for h.
        cosine = math.cos(math.radians(self.tilt_deg))
        nadir_height_m = self.gsd_m_per_px * self.focal_px
        return nadir_height_m * float(cosine**1.5)

    def check(self) -> None:
        """Refuse a plane whose horizon is in the image or close to it.

        Raises:
            TooObliqueError: the ray of a corner descends at less than ten degrees.
        """
        rays = self._rays(self._corners)
        lengths = np.linalg.norm(rays, axis=1)
        descents = rays @ self.down / lengths
        if float(descents.min()) < MIN_DESCENT:
            raise TooObliqueError(
                f"the camera was tilted by {self.tilt_deg:.0f} degrees: the horizon is in the "
                "image or close to it, and no scale holds there. Crop the image to the near ground"
            )

    def ground(self, points: ArrayLike) -> Points:
        """Project pixels onto the ground.

        Args:
            points: ``[n, 2]`` x, y in pixels of the image.

        Returns:
            ``[n, 3]`` metres from the camera, in the camera's frame.

        Raises:
            TooObliqueError: a point lies above the horizon, or close to it.
        """
        rays = self._rays(points)
        descents = self._below_horizon(rays @ self.down)
        return np.asarray(self.height_m * rays / descents[:, None])

    def from_above(self, points: ArrayLike) -> Points:
        """Rectify pixels to a nadir view at the scale of the image's centre.

        Args:
            points: ``[n, 2]`` x, y in pixels of the image.

        Returns:
            ``[n, 2]`` pixels from the image's centre; right stays right.

        Raises:
            TooObliqueError: as in ``ground``.
        """
        return self._nadir_pixels(self.ground(points))

    @property
    def foot(self) -> Vector:
        """``[2]`` point straight below the camera, in the pixels of ``from_above``."""
        ground = self.height_m * self.down
        pixels = self._nadir_pixels(ground[None])
        return np.asarray(pixels[0])

    def gsd_at(self, points: ArrayLike) -> Lengths:
        """Compute the GSD at points of the image.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n]`` metres per pixel: square root of the ground area of a pixel.

        Raises:
            TooObliqueError: as in ``ground``.
        """
        rays = self._rays(points)
        descents = self._below_horizon(rays @ self.down)
        nadir_gsd = self.height_m / self.focal_px
        return np.asarray(nadir_gsd * descents**-1.5)

    @property
    def gsd_range(self) -> tuple[float, float]:
        """Smallest and largest GSD in the image, which occur at corners.

        Raises:
            TooObliqueError: as in ``ground``.
        """
        gsds = self.gsd_at(self._corners)
        return float(gsds.min()), float(gsds.max())

    def area(self, mask: NDArray[np.bool_], left: int = 0, top: int = 0) -> float:
        """Compute the ground area of a mask, square metres: the sum over its pixels.

        Args:
            mask: ``[h, w]`` bool.
            left: column of the image at which the mask begins.
            top: row of the image at which the mask begins.

        Raises:
            TooObliqueError: as in ``ground``.
        """
        total = 0.0
        for start in range(0, len(mask), _ROWS):
            rows, columns = np.nonzero(mask[start : start + _ROWS])
            if len(rows) == 0:
                continue
            # The centre of a pixel lies half a pixel from its upper left corner.
            x = columns + left + 0.5
            y = rows + start + top + 0.5
            gsds = self.gsd_at(np.column_stack([x, y]))
            total += float((gsds**2).sum())
        return total

    def length(self, first: ArrayLike, second: ArrayLike) -> Lengths:
        """Compute the lengths of lines on the ground, metres.

        Args:
            first: ``[n, 2]`` first end of each line, pixels.
            second: ``[n, 2]`` second end of each line, pixels.

        Raises:
            TooObliqueError: as in ``ground``.
        """
        offsets = self.ground(first) - self.ground(second)
        return np.asarray(np.linalg.norm(offsets, axis=1))

    def _nadir_pixels(self, ground: Points) -> Points:
        """Convert points ``[n, 3]`` on the ground to pixels of a nadir view, from the centre."""
        centre = self.ground(self._centre)
        from_centre = (ground - centre) / self.gsd_m_per_px
        # Axes of the ground plane: the image's right without its vertical part, and across it.
        down = self.down
        image_right = np.array([1.0, 0.0, 0.0])
        right = image_right - down[0] * down
        right /= np.linalg.norm(right)
        across = np.cross(down, right)
        axes = np.column_stack([right, across])
        return np.asarray(from_centre @ axes)

    @property
    def _centre(self) -> Vector:
        return np.array([self.width_px / 2, self.height_px / 2])

    @property
    def _corners(self) -> Points:
        right = float(self.width_px)
        bottom = float(self.height_px)
        return np.array([(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)])

    def _rays(self, points: ArrayLike) -> Points:
        """Compute the rays ``[n, 3]`` of pixels ``[n, 2]``, with length 1 along the axis."""
        pixels = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        across_axis = (pixels - self._centre) / self.focal_px
        along_axis = np.ones(len(pixels))
        return np.column_stack([across_axis, along_axis])

    def _below_horizon(self, descents: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the descents ``[n]`` of rays; refuse rays at the horizon and above."""
        if len(descents) and float(descents.min()) < MIN_DESCENT:
            raise TooObliqueError(
                f"the camera was tilted by {self.tilt_deg:.0f} degrees, and a point lies above the "
                "horizon or close to it, where no scale holds: crop the image to the near ground"
            )
        return descents
