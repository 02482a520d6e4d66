"""A reconstruction in its own units: lenses, shots and points.

Camera frames are those of OpenCV: x to the right, y to the lower side, z along the axis. A point X
of the model is at ``rotation X + translation`` in the frame of a shot. Pixels have their origin at
the upper left corner of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np

from vehanchor.errors import ReconstructionError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    from vehanchor_flight.records import ModelSource

    Pixels: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    Rays: TypeAlias = NDArray[np.float64]
    """Directions ``[n, 3]``."""

    Vector: TypeAlias = NDArray[np.float64]
    """Point or direction ``[3]``."""

    Matrix: TypeAlias = NDArray[np.float64]
    """Rotation ``[3, 3]``."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the points have a property."""

    Points: TypeAlias = NDArray[np.float64]
    """Points ``[n, 3]`` in model units."""

_ASPECT_TOLERANCE = 0.01
_MIN_COEFFICIENTS = 4  # OpenCV takes no fewer coefficients of distortion.


@dataclass(frozen=True)
class Lens:
    """Intrinsic calibration of a camera, in pixels of an image of a given size.

    Attributes:
        width_px: width of the image.
        height_px: its height.
        focal_x_px: focal length across.
        focal_y_px: focal length down.
        centre_x_px: principal point, from the left side.
        centre_y_px: principal point, from the upper side.
        distortion: coefficients in the order of OpenCV: k1, k2, p1, p2, k3 ..., or k1 to k4 of a
            fisheye.
        fisheye: whether the lens is a fisheye.
    """

    width_px: float
    height_px: float
    focal_x_px: float
    focal_y_px: float
    centre_x_px: float
    centre_y_px: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    @property
    def focal_px(self) -> float:
        """Mean focal length."""
        return float(np.sqrt(self.focal_x_px * self.focal_y_px))

    def fits(self, width_px: int, height_px: int) -> bool:
        """Check whether an image, perhaps a copy of another size, has the lens's proportions."""
        across = width_px / self.width_px
        down = height_px / self.height_px
        return abs(across / down - 1) <= _ASPECT_TOLERANCE

    def of_size(self, width_px: int, height_px: int) -> Lens:
        """Convert the lens to a copy of the image of another size.

        Raises:
            ReconstructionError: the copy has another aspect ratio.
        """
        across = width_px / self.width_px
        down = height_px / self.height_px
        if not self.fits(width_px, height_px):
            size_in_model = f"{self.width_px:g} x {self.height_px:g}"
            raise ReconstructionError(
                f"the photograph has {width_px} x {height_px} px, and its camera in the model "
                f"{size_in_model}: give the photographs from which the "
                "model was made, neither cropped nor turned"
            )
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_x_px=self.focal_x_px * across,
            focal_y_px=self.focal_y_px * down,
            centre_x_px=self.centre_x_px * across,
            centre_y_px=self.centre_y_px * down,
        )

    def directions(self, points: ArrayLike) -> Rays:
        """Compute the rays of pixels.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n, 3]`` in the camera's frame, with z = 1; not finite beyond the reach of the lens
            model.
        """
        pixels = np.asarray(points, dtype=np.float64)
        pixels = pixels.reshape(-1, 2)
        focals = [self.focal_x_px, self.focal_y_px]
        centre = np.array([self.centre_x_px, self.centre_y_px], np.float64)
        # The pinhole of an ideal lens: x / z and y / z of the ray.
        slopes: Pixels = (pixels - centre) / focals
        is_distorted = self.fisheye or any(self.distortion)
        if is_distorted and len(pixels):
            slopes = self._undistorted(pixels)
        depths = np.ones(len(slopes))
        return np.column_stack([slopes, depths])

    def _undistorted(self, pixels: Pixels) -> Pixels:
        """Invert the distortion of the lens.

        Args:
            pixels: ``[n, 2]``.

        Returns:
            ``[n, 2]`` slopes of the rays, x / z and y / z.
        """
        matrix = np.array(
            [
                [self.focal_x_px, 0, self.centre_x_px],
                [0, self.focal_y_px, self.centre_y_px],
                [0, 0, 1],
            ],
            np.float64,
        )
        n_missing = _MIN_COEFFICIENTS - len(self.distortion)
        padding = (0.0,) * n_missing
        coefficients = np.array(self.distortion + padding)
        undistort: Any = cv2.undistortPoints
        if self.fisheye:
            undistort = cv2.fisheye.undistortPoints
        # OpenCV takes and returns points as [n, 1, 2].
        slopes = undistort(pixels[:, None], matrix, coefficients)
        slopes = np.asarray(slopes, np.float64)
        return slopes.reshape(-1, 2)

    def ideal(self, points: ArrayLike) -> Pixels:
        """Convert pixels to those of a pinhole camera of the same size and focal length.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n, 2]`` x, y in pixels of the pinhole camera.
        """
        slopes = self.directions(points)[:, :2]
        centre = [self.width_px / 2, self.height_px / 2]
        pixels = slopes * self.focal_px + centre
        return np.asarray(pixels, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Shot:
    """Photograph with its camera and pose.

    Attributes:
        name: file name, relative to the folder of the photographs.
        lens: of its camera.
        rotation: ``[3, 3]`` from the model's frame to the camera's.
        translation: ``[3]`` position of the model's origin in the camera's frame, model units.
    """

    name: str
    lens: Lens
    rotation: Matrix
    translation: Vector

    @property
    def centre(self) -> Vector:
        """``[3]`` position of the camera, model units."""
        return np.asarray(-self.rotation.T @ self.translation)

    def rays(self, points: ArrayLike) -> Rays:
        """Compute the rays of pixels.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n, 3]`` in the model's frame, one unit along the camera's axis.
        """
        directions = self.lens.directions(points)
        return np.asarray(directions @ self.rotation)

    def sees(self, points: Points) -> Flags:
        """Find the points that lie in the picture; the distortion of the lens is ignored.

        Args:
            points: ``[n, 3]`` in the model's frame.

        Returns:
            ``[n]`` bool.
        """
        lens = self.lens
        camera_points = points @ self.rotation.T + self.translation
        x, y, z = camera_points.T
        is_ahead = z > 0
        depth = np.where(is_ahead, z, 1.0)
        across = lens.focal_x_px * x / depth + lens.centre_x_px
        down = lens.focal_y_px * y / depth + lens.centre_y_px
        is_in_width = (across >= 0) & (across <= lens.width_px)
        is_in_height = (down >= 0) & (down <= lens.height_px)
        return np.asarray(is_ahead & is_in_width & is_in_height)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Largest connected part of a model.

    Attributes:
        kind: format of its files.
        path: file or folder from which it was read.
        shots: photographs with their poses.
        points: ``[n, 3]`` float64, model units.
        n_parts: connected parts in the files; each has its own scale.
        origin: latitude, longitude (degrees) and altitude (metres) of the model's origin, whose
            axes then point to the east, to the north and up; None if unknown.
    """

    kind: ModelSource
    path: Path
    shots: tuple[Shot, ...]
    points: Points
    n_parts: int = 1
    origin: tuple[float, float, float] | None = None
