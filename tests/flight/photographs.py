"""Photographs of one flight, painted for the stand-in detector."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from tests.models import blank_image, paint_vehicles

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


def car_park(lengths: Sequence[float]) -> NDArray[np.uint8]:
    """RGB with a vehicle of each length."""
    image = blank_image(480, 360)
    boxes = [[40 + 70 * (k % 6), 50 + 60 * (k // 6), length, 12, 0.4] for k, length in enumerate(lengths)]
    paint_vehicles(image, np.reshape(boxes, (-1, 5)))
    return image


def write_flight(folder: Path, fleets: Sequence[Sequence[float]]) -> list[str]:
    """A photograph for each of some fleets, ``0.png``, ``1.png`` and so on; their paths."""
    paths = []
    for number, lengths in enumerate(fleets):
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), car_park(lengths)[:, :, ::-1])
        paths.append(str(path))
    return paths
