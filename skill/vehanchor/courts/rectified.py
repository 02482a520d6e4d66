"""Courts in oblique images, found in a rectified view of the ground."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.courts.find import find_courts, propose_courts, rough_court
from vehanchor.courts.fit import project
from vehanchor.detection.detections import Objects
from vehanchor.imagery.raster import Raster, StoredPixels, Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.court import Court
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.models.runtime import Runtime
    from vehanchor.scale.plane import GroundPlane

_FARTHEST = 1.2  # from the centre, in image sizes; courts farther away are too small
_MARGIN_PX = 2


class RectifiedRaster(Raster):
    """Rectified view of an image at the scale of its centre; each window reads only the pixels it needs.

    Args:
        raster: the image.
        plane: ground plane of the image; its scale does not matter.
    """

    def __init__(self, raster: Raster, plane: GroundPlane) -> None:
        corners = np.array([(0, 0), (raster.width_px, 0), (raster.width_px, raster.height_px), (0, raster.height_px)])
        level = plane.from_above(corners)
        reach = _FARTHEST * np.array([raster.width_px, raster.height_px])
        low, high = np.clip(level.min(axis=0), -reach, 0), np.clip(level.max(axis=0), 0, reach)
        super().__init__("array", *(int(size) for size in np.ceil(high - low)))
        self._raster = raster
        move = cv2.getPerspectiveTransform((level - low).astype(np.float32), corners.astype(np.float32))
        self._to_image = np.asarray(move, dtype=np.float64)

    def in_image(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points ``[n, 2]`` of this view to the image; 0 is the left and upper edge of both."""
        return project(self._to_image, points)

    def _read_stored(self, window: Window) -> StoredPixels:
        right, bottom = window.x_px + window.width_px, window.y_px + window.height_px
        outline = self.in_image(
            np.array([(window.x_px, window.y_px), (right, window.y_px), (right, bottom), (window.x_px, bottom)])
        )
        size = np.array([self._raster.width_px, self._raster.height_px])
        low = np.clip(np.floor(outline.min(axis=0)) - _MARGIN_PX, 0, size - 1).astype(int)
        high = np.clip(np.ceil(outline.max(axis=0)) + _MARGIN_PX, low + 1, size).astype(int)
        pixels = self._raster.read(Window(int(low[0]), int(low[1]), *(int(each) for each in high - low)))
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # from a pixel's centre to its corner
        here = np.array([[1, 0, window.x_px], [0, 1, window.y_px], [0, 0, 1]])
        there = np.array([[1, 0, -low[0]], [0, 1, -low[1]], [0, 0, 1]])
        move = np.linalg.inv(half) @ there @ self._to_image @ here @ half
        seen = cv2.warpPerspective(
            pixels,
            move,
            (window.width_px, window.height_px),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_CONSTANT,
        )
        return StoredPixels(np.asarray(seen, np.uint8), None)


def rough_courts_on(
    raster: Raster,
    plane: GroundPlane,
    detections: Detections,
    card: DetectorCard,
    *,
    most: int,
    runtime: Runtime | None = None,
) -> list[Court]:
    """Find courts that can be recognised only in perspective; the tilt is unknown.

    Args:
        raster: the image.
        plane: ground plane of the image, correct to about ten degrees; its scale does not matter.
        detections: detections of the search.
        card: model card of the detector.
        most: number of proposals to try, the highest scores first.
        runtime: as in ``find_courts``.

    Returns:
        Courts in the image; verify each on the ground plane that its shape implies.
    """
    level = RectifiedRaster(raster, plane)
    nothing = replace(detections, others=Objects.joined())  # they refer to the unrectified image
    proposed = propose_courts(level, nothing, card, runtime=runtime)
    best = sorted(proposed.proposals, key=lambda each: -each.share)[:most]
    rough = [court for each in best if (court := rough_court(level, each)) is not None]
    return [replace(each, shape=None if each.shape is None else level.in_image(each.shape)) for each in rough]


def find_courts_on(
    raster: Raster,
    plane: GroundPlane,
    detections: Detections,
    card: DetectorCard,
    *,
    runtime: Runtime | None = None,
) -> tuple[Court, ...]:
    """Find courts as ``find_courts`` does, in an oblique image.

    Args:
        raster: the image.
        plane: ground plane of the image, correct to about five degrees; its scale does not matter.
        detections: detections of the search.
        card: model card of the detector.
        runtime: as in ``find_courts``.

    Returns:
        Courts with corners in the image. Their GSD holds at the image's centre if the plane is correct.
    """
    level = RectifiedRaster(raster, plane)
    nothing = replace(detections, others=Objects.joined())  # they refer to the unrectified image
    courts = find_courts(level, nothing, card, runtime=runtime)
    size = raster.width_px, raster.height_px
    found = [
        replace(
            court,
            corners=level.in_image(court.corners),
            shape=None if court.shape is None else level.in_image(court.shape),
        )
        for court in courts
    ]
    return tuple(court for court in found if (court.corners >= 0).all() and (court.corners <= size).all())
