"""Verifier: an auxiliary model that scores each candidate of the detector again, with its surroundings.

A candidate's *chip* shows it and its surroundings, rotated along its axis and resized to one length. From the chip a
small network predicts the logit of a car. The score combines the detector's logit, this logit and, with a scene-scale
prior, how well the candidate's size fits a car.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NamedTuple

import cv2
import numpy as np

from vehanchor.detection.auxiliary import AuxiliaryModel
from vehanchor.detection.card import VerifierCard
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

CHIP_PX = 48  # rows and columns
CHIP_LENGTH_PX = 20.0  # candidate's length on its chip, along the columns; leaves 0.7 lengths on either side
_SHARPNESS = 1.5  # resolution to which the image is averaged before sampling, in units of the chip's
_BATCH = 64  # chips per run: a car park has a thousand candidates
_MARGIN = 1e-4  # scores are clipped: 0 and 1 have no logit


def surroundings(
    pixels: NDArray[np.uint8], boxes: ArrayLike, side_px: int = CHIP_PX, length_px: float = CHIP_LENGTH_PX
) -> NDArray[np.uint8]:
    """Cut chips of candidates with their surroundings.

    Args:
        pixels: ``[h, w, 3]`` uint8 RGB.
        boxes: ``[n, 5]``, ``(x, y, length, width, angle)`` in their pixels and radians; the width is not used.
        side_px: rows and columns of a chip.
        length_px: a candidate's length on its chip.

    Returns:
        ``[n, side, side, 3]`` uint8: the box is centred, its axis along the columns. Outside the pixels their border
        is repeated.
    """
    rows = np.asarray(boxes, np.float64).reshape(-1, 5)
    bounds, sizes, matrices = _parts(rows, pixels.shape[1], pixels.shape[0], side_px, length_px)
    chips = np.empty((len(rows), side_px, side_px, 3), np.uint8)
    for chip, (left, top, right, bottom), (width, height), matrix in zip(
        chips, bounds.tolist(), sizes.tolist(), matrices, strict=True
    ):
        part = pixels[top:bottom, left:right]
        if (height, width) != part.shape[:2]:
            part = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(part, matrix, (side_px, side_px), dst=chip, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return chips


def _parts(
    boxes: NDArray[np.float64], width_px: int, height_px: int, side_px: int, length_px: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Compute the parts of the image from which chips are cut, at once; a loop over boxes takes longer than the cuts.

    Returns:
        ``[n, 4]`` left, top, right and bottom of each part; ``[n, 2]`` width and height to which it is reduced; and
        ``[n, 2, 3]`` matrices from the chip to the reduced part.
    """
    centres, angles = boxes[:, :2], boxes[:, 4]
    step = boxes[:, 2] / length_px  # pixels per pixel of the chip
    reach = (0.75 * side_px * step + 2)[:, None]  # beyond the corners of the turned chip
    ends = np.array([width_px, height_px])
    first = np.clip(centres - reach, 0, ends - 1).astype(np.intp)
    last = np.maximum(np.clip(centres + reach + 1, 1, ends).astype(np.intp), first + 1)
    extent = last - first
    sizes = np.maximum(1, np.rint(extent * np.minimum(1.0, _SHARPNESS / step)[:, None])).astype(np.intp)
    ratio = sizes / extent
    cosine, sine = np.cos(angles), np.sin(angles)
    turn = step[:, None, None] * np.array([[cosine, -sine], [sine, cosine]]).transpose(2, 0, 1)  # chip -> pixels
    origin = centres - first - turn @ [side_px / 2, side_px / 2]
    matrices = np.concatenate([turn * ratio[:, :, None], (origin * ratio)[:, :, None]], axis=2)
    # Continuous coordinates have pixel centres at +0.5.
    matrices[:, :, 2] += matrices[:, :, :2] @ (0.5, 0.5) - 0.5
    return np.concatenate([first, last], axis=1), sizes, matrices


class Weights(NamedTuple):
    """Weights of the detector's logit, the verifier's logit and the size odds in the combined logit.

    Attributes:
        detector: weight of the detector's logit.
        verifier: weight of the verifier's logit.
        bias: constant term.
        size: weight of the size odds.
    """

    detector: float
    verifier: float
    bias: float
    size: float = 0.0

    def score(self, scores: ArrayLike, logits: ArrayLike, size_odds: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Combine the detector's scores, the verifier's logits and the size odds into scores ``[n]`` in [0, 1]."""
        first = np.clip(np.asarray(scores, np.float64), _MARGIN, 1 - _MARGIN)
        total = self.detector * np.log(first / (1 - first)) + self.verifier * np.asarray(logits, np.float64) + self.bias
        total = total + self.size * np.asarray(size_odds, np.float64)
        return np.asarray(1 / (1 + np.exp(-np.clip(total, -50, 50))))


class Verifier(AuxiliaryModel[VerifierCard]):
    """Network from chips of candidates ``[n, 3, 48, 48]`` to the logit of a car, ``logit [n]``."""

    named = "verifier"
    trained_by = "research/training/verifier"
    chip_shape = (3, CHIP_PX, CHIP_PX)
    outputs: ClassVar = {"logit": ()}
    card_type = VerifierCard

    def scored(self, pixels: NDArray[np.uint8], found: Objects, *, size_odds: ArrayLike = 0.0) -> Objects:
        """Replace the scores of candidates by the combined scores.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, the tile in which they were found.
            found: candidates, in its pixels.
            size_odds: ``[n]`` how well their sizes fit (see ``SceneScalePrior.size_odds``); 0 without a prior.
        """
        logits = [np.zeros(0)]
        for start in range(0, len(found), _BATCH):
            logits.append(self.logits(surroundings(pixels, found.boxes[start : start + _BATCH])))
        scores = Weights(*self.card.weights).score(found.scores, np.concatenate(logits), size_odds)
        return Objects(found.boxes, scores, found.classes)

    def logits(self, chips: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Predict the logits of cars ``[n]`` from chips ``[n, 48, 48, 3]``, see ``surroundings``."""
        return self.predict(chips)[0]
