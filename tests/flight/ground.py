"""A piece of ground with detail at every size, and photographs of it from any height."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.models import car_park
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.sources.opening import open_raster
from vehanchor_flight.features import Features, find_features

_LATITUDE = 46.0
_METRES_A_DEGREE = 111_195.0


def ground(side_px: int = 1600, seed: int = 5) -> NDArray[np.uint8]:
    """Make grey patches of all sizes, ``[side, side, 3]``."""
    rng = np.random.default_rng(seed)
    image = np.full((side_px, side_px), 110.0, np.float32)
    for _ in range(2600):
        x, y = rng.integers(0, side_px, 2).tolist()
        width, height = rng.uniform(4, 40, 2).tolist()
        box = ((float(x), float(y)), (width, height), float(rng.uniform(0, 180)))
        corners = cv2.boxPoints(box).astype(np.int32)
        cv2.fillPoly(image, [corners], float(rng.uniform(20, 235)))
    noisy = image + rng.normal(0, 3, image.shape)
    grey = np.clip(noisy, 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def photograph_of(
    world: NDArray[np.uint8],
    x: float,
    y: float,
    *,
    turn_deg: float = 0.0,
    scale: float = 1.0,
    side_px: int = 500,
) -> NDArray[np.uint8]:
    """Photograph the ground around (x, y): ``scale`` pixels of the ground a pixel, turned."""
    move = np.array(cv2.getRotationMatrix2D((x, y), turn_deg, 1 / scale), dtype=np.float64)
    move[:, 2] += side_px / 2 - np.array([x, y])
    size = (side_px, side_px)
    if scale > 1:
        blurred = cv2.GaussianBlur(world, (0, 0), 0.4 * scale)
        photograph = cv2.warpAffine(blurred, move, size, flags=cv2.INTER_AREA)
    else:
        photograph = cv2.warpAffine(world, move, size, flags=cv2.INTER_LINEAR)
    return np.asarray(photograph, dtype=np.uint8)


def features_of(image: NDArray[np.uint8]) -> Features:
    """Find the features of an array."""
    with open_raster(image) as raster:
        return find_features(raster)


def facts_at(east_m: float, north_m: float, side_px: int = 500) -> ImageFacts:
    """Make the facts of a photograph taken there."""
    latitude = _LATITUDE + north_m / _METRES_A_DEGREE
    longitude = 7.0 + east_m / (_METRES_A_DEGREE * np.cos(np.radians(_LATITUDE)))
    camera = CameraMetadata(latitude_deg=latitude, longitude_deg=float(longitude))
    return ImageFacts(side_px, side_px, camera=camera)


def vehicles_of(lengths: NDArray[np.float64]) -> Detections:
    """Make detections of vehicles of these lengths."""
    angles = np.zeros(len(lengths))
    boxes = np.column_stack([lengths, lengths, lengths, lengths / 2, angles])
    return Detections(boxes, np.full(len(boxes), 0.8))


def write_flight(folder: Path, fleets: Sequence[Sequence[float]]) -> list[str]:
    """Write a photograph for each fleet, ``0.png``, ``1.png`` and so on; return their paths."""
    paths = []
    for number, lengths in enumerate(fleets):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), car_park(lengths)[:, :, ::-1])
        paths.append(str(path))
    return paths


def write_film(
    path: Path, frames: Iterable[NDArray[np.uint8]], per_second: float = 10.0, codec: str = "MJPG"
) -> str:
    """Write a video of these frames, BGR; return its path."""
    all_frames = list(frames)
    height, width, _ = all_frames[0].shape
    fourcc = cv2.VideoWriter.fourcc(*codec)
    writer = cv2.VideoWriter(str(path), fourcc, per_second, (width, height))
    for frame in all_frames:
        writer.write(frame)
    writer.release()
    return str(path)
