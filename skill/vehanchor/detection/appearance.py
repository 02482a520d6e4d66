"""Appearance of vehicles: chips for the fleet network, and the reference length that its output implies.

A *chip* shows a vehicle without its scale: one channel, rotated along the vehicle's axis, resized to a length of 16 px,
blurred and standardised. From a chip the fleet network predicts two numbers. The first is the log of the vehicle's
length in metres; its mean over an image sets the reference length. The second is the log odds of North America's fleet;
its spread distinguishes cars of many makes from identical objects.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vehanchor.imagery.raster import Raster

CHIP_LENGTH_PX = 16  # a car of 5 m at 0.3 m/px, the coarsest that the guard lets pass
CHIP_SHAPE = (16, 24)  # rows and columns: the vehicle and a quarter of its length around it
MAX_CHIPS = 100  # more vehicles add no information
_CHIP_CHANNEL = 1  # green: sharpest of most cameras, and not the one that near infrared replaces
_BLUR_PX = 1.0  # pixels of the chip; exceeds the differences between cameras
_CONTRAST_FLOOR = 8.0  # grey levels; added to the standard deviation so that noise is not amplified
_REACH = 1.15  # vehicle lengths from the centre to the farthest pixel that a chip needs, blur included


class FleetAppearance(NamedTuple):
    """Fleet network's predictions for vehicles.

    Attributes:
        log_odds: ``[n]`` float64, log odds that each belongs to North America's fleet.
        log_lengths: ``[n]`` float64, log of each predicted length in metres.
    """

    log_odds: NDArray[np.float64]
    log_lengths: NDArray[np.float64]

    def take(self, kept: NDArray[np.bool_]) -> FleetAppearance:
        """Select the vehicles of a mask ``[n]``."""
        return FleetAppearance(self.log_odds[kept], self.log_lengths[kept])


class FleetLengths(NamedTuple):
    """Calibration from predicted vehicle lengths to a reference length.

    Attributes:
        log_lengths: two mean log lengths; the reference length is linear between them and constant outside.
        length_m: reference lengths at these two, metres.
        sd_m: residual standard deviation between places, metres.
        neutral_vehicles: number of vehicles of the middle length that are added to every image, as a prior.
    """

    log_lengths: tuple[float, float]
    length_m: tuple[float, float]
    sd_m: float
    neutral_vehicles: float

    def reference_length(self, vehicle_log_lengths: ArrayLike) -> float:
        """Compute the reference length of a fleet.

        Args:
            vehicle_log_lengths: ``[n]`` predicted log lengths of its vehicles, n >= 0.

        Returns:
            Metres.
        """
        values = np.asarray(vehicle_log_lengths, dtype=np.float64)
        neutral = self.neutral_vehicles
        mean = (values.sum() + neutral * sum(self.log_lengths) / 2) / (len(values) + neutral)
        return float(np.interp(mean, self.log_lengths, self.length_m))

    def sampling_log_sd(self, vehicle_log_lengths: ArrayLike) -> float:
        """Compute the standard error of the log of ``reference_length`` from the spread of the vehicles.

        Args:
            vehicle_log_lengths: ``[n]`` predicted log lengths, n >= 2.
        """
        values = np.asarray(vehicle_log_lengths, dtype=np.float64)
        slope = (self.length_m[1] - self.length_m[0]) / (self.log_lengths[1] - self.log_lengths[0])
        return float(slope * values.std(ddof=1) / (math.sqrt(len(values)) * self.reference_length(values)))


def chip(pixels: NDArray[np.uint8], box: ArrayLike) -> NDArray[np.float32]:
    """Cut a vehicle from one channel.

    Args:
        pixels: ``[h, w]`` uint8.
        box: ``(x, y, length, width, angle)`` in their pixels and radians; the width is not used.

    Returns:
        ``CHIP_SHAPE``, mean 0, standard deviation 1 (less at low contrast). Outside the pixels their border is
        repeated.
    """
    x, y, length, _, angle = np.asarray(box, dtype=np.float64)
    step = length / CHIP_LENGTH_PX  # pixels per pixel of the chip
    smooth = cv2.GaussianBlur(pixels.astype(np.float32), (0, 0), _BLUR_PX * step, borderType=cv2.BORDER_REPLICATE)
    turn = step * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rows, columns = CHIP_SHAPE
    origin = np.array([x - 0.5, y - 0.5]) - turn @ [(columns - 1) / 2, (rows - 1) / 2]
    cut = cv2.warpAffine(
        smooth,
        np.column_stack([turn, origin]),
        (columns, rows),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray((cut - cut.mean()) / (cut.std() + _CONTRAST_FLOOR), dtype=np.float32)


def vehicle_chips(raster: Raster, boxes: NDArray[np.float64]) -> NDArray[np.float32]:
    """Cut the chips of vehicles from an image.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in image pixels, centres inside the image.

    Returns:
        ``[n, 1, 16, 24]`` float32.
    """
    out = np.empty((len(boxes), 1, *CHIP_SHAPE), np.float32)
    shorter = min(raster.width_px, raster.height_px)
    for k, box in enumerate(boxes):
        factor = 2 ** max(0, math.floor(math.log2(min(box[2] / CHIP_LENGTH_PX, shorter))))
        pixels, inside = read_around(raster, box, factor, _REACH)
        out[k, 0] = chip(pixels[:, :, _CHIP_CHANNEL], inside)
    return out
