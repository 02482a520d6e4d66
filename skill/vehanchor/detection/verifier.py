"""Auxiliary models, which run on chips of a detector's boxes, and the verifier, which scores each candidate again.

A candidate's *chip* shows it and its surroundings, rotated along its axis and resized to one
length. From the chip a small network predicts the logit of a car. The score combines the detector's
logit, this logit and, with a scene-scale prior, how well the candidate's size fits a car.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Generic, NamedTuple, TypeVar

import cv2
import numpy as np

from vehanchor.detection.card import AuxiliaryCard, VerifierCard, read_card
from vehanchor.detection.detections import Objects
from vehanchor.errors import ModelContractError
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

CHIP_PX = 48  # rows and columns
# candidate's length on its chip, along the columns; leaves 0.7 lengths on either side
CHIP_LENGTH_PX = 20.0
# resolution to which the image is averaged before sampling, in units of the chip's
_SHARPNESS = 1.5
_BATCH = 64  # chips per run: a car park has a thousand candidates
_MARGIN = 1e-4  # scores are clipped: 0 and 1 have no logit
_CardT = TypeVar("_CardT", bound=AuxiliaryCard)
_INPUT = "chips"


def surroundings(
    pixels: NDArray[np.uint8],
    boxes: ArrayLike,
    side_px: int = CHIP_PX,
    length_px: float = CHIP_LENGTH_PX,
) -> NDArray[np.uint8]:
    """Cut chips of candidates with their surroundings.

    Args:
        pixels: ``[h, w, 3]`` uint8 RGB.
        boxes: ``[n, 5]``, ``(x, y, length, width, angle)`` in their pixels and radians; the width
            is not used.
        side_px: rows and columns of a chip.
        length_px: a candidate's length on its chip.

    Returns:
        ``[n, side, side, 3]`` uint8: the box is centred, its axis along the columns. Outside the
        pixels their border is repeated.
    """
    rows = np.asarray(boxes, np.float64).reshape(-1, 5)
    bounds, sizes, matrices = _parts(rows, pixels.shape[1], pixels.shape[0], side_px, length_px)
    chips = np.empty((len(rows), side_px, side_px, 3), np.uint8)
    for chip, (left, top, right, bottom), (width, height), matrix in zip(
        chips, bounds.tolist(), sizes.tolist(), matrices, strict=True
    ):
        part = pixels[top:bottom, left:right]
        if (height, width) != part.shape[:2]:
            part = np.asarray(
                cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA), np.uint8
            )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(
            part, matrix, (side_px, side_px), dst=chip, flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    return chips


def _parts(
    boxes: NDArray[np.float64], width_px: int, height_px: int, side_px: int, length_px: float
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Compute the parts of the image from which chips are cut, at once; a loop over boxes takes longer than the cuts.

    Returns:
        ``[n, 4]`` left, top, right and bottom of each part; ``[n, 2]`` width and height to which it
        is reduced; and ``[n, 2, 3]`` matrices from the chip to the reduced part.
    """
    centres = boxes[:, :2]
    angles = boxes[:, 4]
    step = boxes[:, 2] / length_px  # pixels per pixel of the chip
    reach = (0.75 * side_px * step + 2)[:, None]  # beyond the corners of the turned chip
    ends = np.array([width_px, height_px])
    first = np.clip(centres - reach, 0, ends - 1).astype(np.intp)
    last = np.maximum(np.clip(centres + reach + 1, 1, ends).astype(np.intp), first + 1)
    extent = last - first
    sizes = np.maximum(1, np.rint(extent * np.minimum(1.0, _SHARPNESS / step)[:, None])).astype(
        np.intp
    )
    ratio = sizes / extent
    cosine = np.cos(angles)
    sine = np.sin(angles)
    # chip -> pixels
    turn = step[:, None, None] * np.array([[cosine, -sine], [sine, cosine]]).transpose(2, 0, 1)
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

    def score(
        self, scores: ArrayLike, logits: ArrayLike, size_odds: ArrayLike = 0.0
    ) -> NDArray[np.float64]:
        """Combine the detector's scores, the verifier's logits and the size odds into scores ``[n]`` in [0, 1]."""
        first = np.clip(np.asarray(scores, np.float64), _MARGIN, 1 - _MARGIN)
        total = (
            self.detector * np.log(first / (1 - first))
            + self.verifier * np.asarray(logits, np.float64)
            + self.bias
        )
        total = total + self.size * np.asarray(size_odds, np.float64)
        return np.asarray(1 / (1 + np.exp(-np.clip(total, -50, 50))))


class AuxiliaryModel(LoadedModel, Generic[_CardT]):
    """Network from ``chips [n, c, h, w]`` float32 to outputs with a row for each chip.

    Args:
        path: the ONNX file.
        runtime: how to open it; None for the defaults.

    Attributes:
        path: the ONNX file.
        card: model card.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is another kind of network, or its metadata are incomplete.
        ProviderUnavailableError: an execution provider is not installed.
    """

    named: ClassVar[str]
    trained_by: ClassVar[str]
    chip_shape: ClassVar[tuple[int, int, int]]
    outputs: ClassVar[Mapping[str, tuple[int, ...]]]  # names, and shapes of a row
    card_type: ClassVar[type[AuxiliaryCard]]

    card: _CardT

    def __init__(self, path: str | Path, *, runtime: Runtime | None = None) -> None:
        self.path = Path(path)
        self.runtime = runtime or Runtime()
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, runtime=self.runtime)
        inputs = self._session.get_inputs()
        outputs = self._session.get_outputs()
        names = [each.name for each in (*inputs, *outputs)]
        if names != [_INPUT, *self.outputs] or tuple(inputs[0].shape[1:]) != self.chip_shape:
            channels, height, width = self.chip_shape
            raise ModelContractError(
                f"{self.path} has {', '.join(names)}: expected {_INPUT} [n, {channels}, "
                f"{height}, {width}] and "
                f"{', '.join(self.outputs)}, as {self.trained_by} writes them"
            )
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.card = read_card(
            self.card_type, self.path, sha256=models_sha256(file), metadata=metadata
        )  # type: ignore[assignment]

    def predict(self, chips: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
        """Run the network on chips.

        Args:
            chips: ``[n, h, w, 3]`` uint8 RGB.

        Returns:
            The outputs in their order, ``[n, ...]`` each.

        Raises:
            ModelContractError: the network fails, or does not give finite numbers for each chip.
            OutOfMemoryError: there is too little memory for it now.
        """
        planes = np.ascontiguousarray(chips.transpose(0, 3, 1, 2))
        batch: NDArray[np.float32] = np.divide(planes, np.float32(255), dtype=np.float32)
        described = f"the {self.named} {self.path} fails on {list(batch.shape)}"
        results = run_session(
            self._session,
            list(self.outputs),
            feeds={_INPUT: batch},
            runtime=self.runtime,
            described=described,
        )
        numbers = [np.asarray(each, np.float64) for each in results]
        shapes = [(len(chips), *shape) for shape in self.outputs.values()]
        if [each.shape for each in numbers] != shapes or not all(
            np.isfinite(each).all() for each in numbers
        ):
            raise ModelContractError(
                f"the {self.named} {self.path} does not give numbers for each of its chips"
            )
        return numbers


class Verifier(AuxiliaryModel[VerifierCard]):
    """Network from chips of candidates ``[n, 3, 48, 48]`` to the logit of a car, ``logit [n]``."""

    named = "verifier"
    trained_by = "research/training/verifier"
    chip_shape = (3, CHIP_PX, CHIP_PX)
    outputs: ClassVar = {"logit": ()}
    card_type = VerifierCard

    def scored(
        self, pixels: NDArray[np.uint8], found: Objects, *, size_odds: ArrayLike = 0.0
    ) -> Objects:
        """Replace the scores of candidates by the combined scores.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, the tile in which they were found.
            found: candidates, in its pixels.
            size_odds: ``[n]`` how well their sizes fit (see ``SceneScalePrior.size_odds``); 0
                without a prior.
        """
        logits = [np.zeros(0)]
        for start in range(0, len(found), _BATCH):
            logits.append(self.logits(surroundings(pixels, found.boxes[start : start + _BATCH])))
        scores = Weights(*self.card.weights).score(found.scores, np.concatenate(logits), size_odds)
        return Objects(found.boxes, scores, found.classes)

    def logits(self, chips: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Predict the logits of cars ``[n]`` from chips ``[n, 48, 48, 3]``, see ``surroundings``."""
        return self.predict(chips)[0]
