"""Flights over flat ground, photographed by known cameras, with their models in any units."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from tests.models import blank_image, paint_vehicles

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

FOCAL_PX = 640.0
WIDTH_PX = 640
HEIGHT_PX = 480


class Pose(NamedTuple):
    """Camera above flat ground.

    Attributes:
        x_m: to the right of the ground's upper left corner.
        y_m: below it.
        height_m: above it.
        tilt_deg: of the axis from straight down, towards the upper side of the picture.
        yaw_deg: turn about the vertical.
    """

    x_m: float
    y_m: float
    height_m: float
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Matrix from metres east, north and up to the camera's frame."""
        tilt = np.radians(self.tilt_deg)
        yaw = np.radians(self.yaw_deg)
        nadir = np.diag([1.0, -1.0, -1.0])
        lean = [
            [1, 0, 0],
            [0, np.cos(tilt), np.sin(tilt)],
            [0, -np.sin(tilt), np.cos(tilt)],
        ]
        turn = [
            [np.cos(yaw), -np.sin(yaw), 0],
            [np.sin(yaw), np.cos(yaw), 0],
            [0, 0, 1],
        ]
        return np.asarray(np.array(lean) @ nadir @ np.array(turn))

    @property
    def translation(self) -> NDArray[np.float64]:
        """Position of the ground's corner in the camera's frame, metres."""
        return np.asarray(-self.rotation @ [self.x_m, -self.y_m, self.height_m])

    def photograph(self, ground: NDArray[np.uint8], gsd_m_per_px: float) -> NDArray[np.uint8]:
        """Photograph a picture of the ground through a pinhole."""
        lens = np.array([[FOCAL_PX, 0, WIDTH_PX / 2], [0, FOCAL_PX, HEIGHT_PX / 2], [0, 0, 1]])
        plane = np.column_stack([self.rotation[:, :2], self.translation])
        # OpenCV counts from the centre of the first pixel.
        centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        pixels = np.diag([gsd_m_per_px, -gsd_m_per_px, 1.0])
        homography = np.linalg.inv(centre) @ lens @ plane @ pixels @ centre
        size = (WIDTH_PX, HEIGHT_PX)
        image = cv2.warpPerspective(ground, homography, size, flags=cv2.INTER_LINEAR)
        return np.asarray(image, dtype=np.uint8)

    def pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Find points of the ground in the picture.

        Args:
            places: ``[n, 2]`` metres right of the ground's corner and below it.
        """
        on_ground = np.column_stack([places * [1, -1], np.zeros(len(places))])
        in_camera = on_ground @ self.rotation.T + self.translation
        slopes = in_camera[:, :2] / in_camera[:, 2:]
        return np.asarray(slopes * FOCAL_PX + [WIDTH_PX / 2, HEIGHT_PX / 2])

    def painted(self, cars: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Paint cars for the stand-in detector.

        Args:
            cars: ``[n, 4]`` x, y of the middle, length and direction on the ground; metres and
                radians.
        """
        image = blank_image(WIDTH_PX, HEIGHT_PX)
        directions = np.column_stack([np.cos(cars[:, 3]), np.sin(cars[:, 3])])
        half = directions * cars[:, 2:3] / 2
        first = self.pixels(cars[:, :2] - half)
        second = self.pixels(cars[:, :2] + half)
        along = second - first
        middle = (first + second) / 2
        length = np.linalg.norm(along, axis=1)
        angle = np.arctan2(along[:, 1], along[:, 0])
        boxes = np.column_stack([middle, length, length / 2.21, angle])
        far_corner = [WIDTH_PX - 40, HEIGHT_PX - 40]
        is_inside = ((middle > 40) & (middle < far_corner)).all(axis=1)
        paint_vehicles(image, boxes[is_inside])
        return image


def write_opensfm(
    folder: Path,
    photographs: Sequence[NDArray[np.uint8]],
    poses: Sequence[Pose],
    metres_per_unit: float,
) -> Path:
    """Write a project of OpenSfM over 200 x 200 m of ground; return the file of its model.

    Args:
        folder: of the project; the photographs lie in ``images``.
        photographs: RGB.
        poses: of their cameras.
        metres_per_unit: of the model.
    """
    (folder / "images").mkdir(parents=True)
    shots = {}
    for number, (photograph, pose) in enumerate(zip(photographs, poses, strict=True)):
        name = f"{number}.png"
        cv2.imwrite(str(folder / "images" / name), photograph[:, :, ::-1])
        shots[name] = {
            "camera": "lens",
            "rotation": cv2.Rodrigues(pose.rotation)[0].ravel().tolist(),
            "translation": (pose.translation / metres_per_unit).tolist(),
        }
    rng = np.random.default_rng(3)
    places = rng.uniform(0, 200, (3000, 2)) * [1, -1]
    points = np.column_stack([places, rng.normal(0, 0.05, 3000)]) / metres_per_unit
    lens = {
        "projection_type": "perspective",
        "width": WIDTH_PX,
        "height": HEIGHT_PX,
        "k1": 0.0,
        "k2": 0.0,
        "focal": FOCAL_PX / max(WIDTH_PX, HEIGHT_PX),
    }
    part = {
        "cameras": {"lens": lens},
        "shots": shots,
        "points": {
            str(number): {"coordinates": point.tolist(), "color": [0, 0, 0]}
            for number, point in enumerate(points)
        },
        "reference_lla": {"latitude": 46.0, "longitude": 7.0, "altitude": 500.0},
    }
    file = folder / "reconstruction.json"
    file.write_text(json.dumps([part]), encoding="utf-8")
    return file
