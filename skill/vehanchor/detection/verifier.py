"""The network beside a detector that takes a second look at each candidate, with its surroundings.

The detector sees a whole tile at once. A candidate's *chip* here is what stands around it, turned along its axis and
brought to one length; a small network reads from it the logit that it is a car. Both opinions become one score, in
which the ground has a say, too, where it was looked at: a car-shaped thing is a car only at a car's size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.detection.auxiliary import AuxiliaryModel
from vehanchor.detection.card import VerifierCard
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

CHIP_PX = 48  # rows and columns
CHIP_LENGTH_PX = 20.0  # the candidate's own length on its chip, along the columns: 0.7 lengths of surroundings each way
_SHARPNESS = 1.5  # of the chip's resolution: the image is averaged down to it before it is sampled
_BATCH = 64  # chips at a time: a car park has a thousand candidates
_MARGIN = 1e-4  # scores of 0 and 1 have no logit


def surroundings(
    pixels: NDArray[np.uint8], boxes: ArrayLike, side_px: int = CHIP_PX, length_px: float = CHIP_LENGTH_PX
) -> NDArray[np.uint8]:
    """Cut candidates with what stands around them.

    Args:
        pixels: ``[h, w, 3]`` uint8 RGB.
        boxes: ``[n, 5]``, ``(x, y, length, width, angle)`` in their pixels and radians; the width is not used.
        side_px: rows and columns of a chip.
        length_px: a candidate's length on its chip.

    Returns:
        ``[n, side, side, 3]`` uint8: the box's middle in the chip's middle, its axis along the columns. What lies
        outside the pixels repeats their border.
    """
    parts = _parts(np.asarray(boxes, np.float64).reshape(-1, 5), pixels.shape[1], pixels.shape[0], side_px, length_px)
    chips = np.empty((len(parts.matrices), side_px, side_px, 3), np.uint8)
    bounds, sizes = parts.bounds.tolist(), parts.sizes.tolist()
    for chip, (left, top, right, bottom), (width, height), matrix in zip(
        chips, bounds, sizes, parts.matrices, strict=True
    ):
        part = pixels[top:bottom, left:right]
        if (height, width) != part.shape[:2]:
            part = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        cv2.warpAffine(
            part,
            matrix,
            (side_px, side_px),
            dst=chip,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return chips


class _Parts(NamedTuple):
    """Where chips come from.

    Attributes:
        bounds: ``[n, 4]`` left, top, right and bottom of a part of the pixels.
        sizes: ``[n, 2]`` width and height to which it is reduced.
        matrices: ``[n, 2, 3]`` from the chip to the reduced part.
    """

    bounds: NDArray[np.intp]
    sizes: NDArray[np.intp]
    matrices: NDArray[np.float64]


def _parts(boxes: NDArray[np.float64], width_px: int, height_px: int, side_px: int, length_px: float) -> _Parts:
    """Lay out the chips of all boxes at once: for one at a time this took longer than to cut them."""
    centres, angles = boxes[:, :2], boxes[:, 4]
    step = boxes[:, 2] / length_px  # pixels to one of the chip
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
    return _Parts(np.concatenate([first, last], axis=1), sizes, matrices)


class Weights(NamedTuple):
    """How the opinions become one: weights of the detector's logit, the second look's, and the ground's of the size."""

    detector: float
    look: float
    bias: float  # what is added
    size: float = 0.0

    def score(self, scores: ArrayLike, logits: ArrayLike, size_odds: ArrayLike = 0.0) -> NDArray[np.float64]:
        """Combined scores ``[n]`` in [0, 1] of the detector's scores, the second look's logits, and the sizes' odds."""
        first = np.clip(np.asarray(scores, np.float64), _MARGIN, 1 - _MARGIN)
        total = self.detector * np.log(first / (1 - first)) + self.look * np.asarray(logits, np.float64) + self.bias
        total = total + self.size * np.asarray(size_odds, np.float64)
        return np.asarray(1 / (1 + np.exp(-np.clip(total, -50, 50))))


class Verifier(AuxiliaryModel[VerifierCard]):
    """A network from chips of candidates to the logit of a car: ``chips [n, 3, 48, 48]`` to ``logit [n]``."""

    named = "second look"
    trained_by = "research/training/verifier"
    chip_shape = (3, CHIP_PX, CHIP_PX)
    outputs = ("logit",)
    card_type = VerifierCard

    def judged(
        self,
        pixels: NDArray[np.uint8],
        found: Objects,
        *,
        size_odds: ArrayLike = 0.0,
    ) -> Objects:
        """The same objects with the scores that all opinions make together.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, the tile in which they were found.
            found: candidates, in its pixels.
            size_odds: ``[n]`` how well their sizes fit (see ``SceneScalePrior.size_odds``); 0 where nobody knows.
        """
        logits = [np.zeros(0)]
        for start in range(0, len(found), _BATCH):
            chips = surroundings(pixels, found.boxes[start : start + _BATCH])
            planes = np.ascontiguousarray(chips.transpose(0, 3, 1, 2))
            batch: NDArray[np.float32] = np.divide(planes, np.float32(255), dtype=np.float32)
            logits.extend(self.answers(batch))
        scores = Weights(*self.card.weights).score(found.scores, np.concatenate(logits), size_odds)
        return Objects(found.boxes, scores, found.classes)
