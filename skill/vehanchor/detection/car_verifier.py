"""Car verifier: an auxiliary model that assesses each candidate of a photograph with few vehicles.

Its chips show three candidate lengths at the finest useful resolution. It answers whether the candidate is a small
vehicle in a fitting box, which type it is, and where its corners lie, without shadow. A candidate costs about 6 ms of
one core.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from vehanchor.detection.auxiliary import AuxiliaryModel
from vehanchor.detection.boxes import canonical_boxes
from vehanchor.detection.card import CarVerifierCard
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

CHIP_PX = 96  # rows and columns: three candidate lengths
CHIP_LENGTH_PX = 32.0  # the candidate's length on its chip, along the columns
VEHICLE_TYPES = ("kei", "small", "compact", "saloon", "suv", "pickup", "van", "lorry", "trailer", "other")
_REACH = 2.4  # candidate lengths from the centre to the farthest pixel that a chip needs
_LEAST_LENGTH_PX = 1.5 * CHIP_LENGTH_PX  # of a candidate where it is read; more detail is averaged
_MIRRORS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # along and across the candidate's axis
_BATCH = 16  # chips per run: bounds the memory
_MOST_SHIFT, _MOST_SCALE, _MOST_TURN = 0.3, 0.35, 0.35  # lengths, log, radians: the limits of what training shows


class VerifiedVehicles(NamedTuple):
    """Answers of the car verifier, a row for each candidate; means over mirrored chips.

    Attributes:
        logit: ``[n]`` log odds of a small vehicle in a fitting box, before calibration.
        types: ``[n, 10]`` probabilities of ``VEHICLE_TYPES``.
        box: ``[n, 5]`` correction in the candidate's frame: centre along and across its axis, in candidate lengths;
            log of the true length and of the true width over the candidate's length; turn in radians.
        log_length_m: ``[n]`` log of the length in metres that the appearance suggests.
    """

    logit: NDArray[np.float64]
    types: NDArray[np.float64]
    box: NDArray[np.float64]
    log_length_m: NDArray[np.float64]


def corrected_boxes(boxes: NDArray[np.float64], correction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply corrections to candidates.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians.
        correction: ``[n, 5]``, see ``VerifiedVehicles.box``; clipped to the range of the training.

    Returns:
        ``[n, 5]`` canonical boxes.
    """
    x, y, length, _, angle = boxes.T
    along, across = np.clip(correction[:, :2], -_MOST_SHIFT, _MOST_SHIFT).T * length
    cosine, sine = np.cos(angle), np.sin(angle)
    lengths = length * np.exp(np.clip(correction[:, 2], -_MOST_SCALE, _MOST_SCALE))
    widths = np.minimum(length * np.exp(correction[:, 3]), lengths)
    turn = np.clip(correction[:, 4], -_MOST_TURN, _MOST_TURN)
    rows = [x + cosine * along - sine * across, y + sine * along + cosine * across, lengths, widths, angle + turn]
    return canonical_boxes(np.stack(rows, axis=1))


def candidate_chips(raster: Raster, boxes: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Cut the chips of candidates from an image, each at the finest useful resolution.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in image pixels.

    Returns:
        ``[n, 96, 96, 3]`` uint8 RGB, see ``surroundings``.
    """
    chips = np.empty((len(boxes), CHIP_PX, CHIP_PX, 3), np.uint8)
    shorter = min(raster.width_px, raster.height_px)
    for chip, box in zip(chips, boxes, strict=True):
        factor = 2 ** max(0, math.floor(math.log2(min(box[2] / _LEAST_LENGTH_PX, shorter))))
        pixels, inside = read_around(raster, box, factor, _REACH)
        chip[:] = surroundings(pixels, inside, CHIP_PX, CHIP_LENGTH_PX)[0]
    return chips


class CarVerifier(AuxiliaryModel[CarVerifierCard]):
    """Network from chips ``[n, 3, 96, 96]``, RGB in 0..1, to the four outputs of ``VerifiedVehicles``."""

    named = "car verifier"
    trained_by = "research/training/car_verifier"
    chip_shape = (3, CHIP_PX, CHIP_PX)
    outputs: ClassVar = {"logit": (), "types": (len(VEHICLE_TYPES),), "box": (5,), "log_length_m": ()}
    card_type = CarVerifierCard

    def verify(self, chips: NDArray[np.uint8]) -> VerifiedVehicles:
        """Assess candidates, each on four mirrored chips.

        Args:
            chips: ``[n, 96, 96, 3]`` uint8 RGB, see ``candidate_chips``.

        Raises:
            ModelContractError: the network fails or does not answer in finite numbers.
        """
        total = [np.zeros((len(chips), *shape)) for shape in self.outputs.values()]
        for start in range(0, len(chips), _BATCH):
            part = slice(start, start + _BATCH)
            planes = chips[part].transpose(0, 3, 1, 2)
            for along, across in _MIRRORS:
                mirrored = np.ascontiguousarray(planes[:, :, ::across, ::along])
                logit, types, box, length = self.predict(np.divide(mirrored, np.float32(255), dtype=np.float32))
                shifted = np.exp(types - types.max(axis=1, keepdims=True))
                unmirrored = box * (along, across, 1, 1, along * across)
                answers = (logit, shifted / shifted.sum(axis=1, keepdims=True), unmirrored, length)
                for sum_, answer in zip(total, answers, strict=True):
                    sum_[part] += answer / len(_MIRRORS)
        return VerifiedVehicles(*total)
