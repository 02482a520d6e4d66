"""Verifier: a network that scores each candidate of the detector again; the base of such networks.

A candidate's *chip* shows it and its surroundings, rotated along its axis and resized to one
length. From the chip a small network predicts the logit of a car. The score combines the detector's
logit, this logit and, with a scene-scale prior, how well the candidate's size fits a car.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Generic, NamedTuple, TypeAlias, TypeVar

import cv2
import numpy as np

from vehanchor.detection.card import AuxiliaryCard, VerifierCard, read_card
from vehanchor.detection.detections import Objects
from vehanchor.errors import ModelContractError
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.odds import chances_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    RgbImage: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB."""

    Chips: TypeAlias = NDArray[np.uint8]
    """``[n, rows, columns, 3]`` RGB."""

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

# Rows and columns of a chip.
CHIP_PX = 48
# The candidate's length on its chip, along the columns; it leaves 0.7 lengths on either side.
CHIP_LENGTH_PX = 20.0
# Resolution to which the image is averaged before sampling, over the chip's: against aliasing.
_SHARPNESS = 1.5
# Chips per run, to bound the memory: a car park has a thousand candidates.
_BATCH = 64
# Scores are clipped by it, because 0 and 1 have no logit.
_SCORE_MARGIN = 1e-4
# Combined logits are clipped, so that their exponential is finite.
_MAX_LOGIT = 50
_CardT = TypeVar("_CardT", bound=AuxiliaryCard)
_INPUT = "chips"


def surroundings(
    pixels: RgbImage,
    boxes: ArrayLike,
    side_px: int = CHIP_PX,
    length_px: float = CHIP_LENGTH_PX,
) -> Chips:
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
    height_px, width_px, _ = pixels.shape
    cuts = _cuts(rows, (width_px, height_px), side_px=side_px, length_px=length_px)
    bounds = cuts.bounds.tolist()
    sizes = cuts.sizes.tolist()
    chips = np.empty((len(rows), side_px, side_px, 3), np.uint8)
    for chip, bound, size, matrix in zip(chips, bounds, sizes, cuts.matrices, strict=True):
        left, top, right, bottom = bound
        width, height = size
        part = pixels[top:bottom, left:right]
        if part.shape[:2] != (height, width):
            resized = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
            part = np.asarray(resized, np.uint8)
        cv2.warpAffine(
            part,
            matrix,
            (side_px, side_px),
            dst=chip,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return chips


class _Cuts(NamedTuple):
    """Parts of an image from which chips are cut.

    Attributes:
        bounds: ``[n, 4]`` left, top, right and bottom of each part, pixels of the image.
        sizes: ``[n, 2]`` width and height to which each part is reduced.
        matrices: ``[n, 2, 3]`` affine maps from the chips to the reduced parts.
    """

    bounds: NDArray[np.intp]
    sizes: NDArray[np.intp]
    matrices: NDArray[np.float64]


def _cuts(boxes: Boxes, image_px: tuple[int, int], side_px: int, length_px: float) -> _Cuts:
    """Compute all cuts at once: a loop over the boxes would take longer than the cuts.

    Args:
        boxes: ``[n, 5]`` candidates in pixels of the image.
        image_px: width and height of the image.
        side_px: rows and columns of a chip.
        length_px: a candidate's length on its chip.
    """
    centres = boxes[:, :2]
    angles = boxes[:, 4]
    # Pixels of the image per pixel of the chip.
    step = boxes[:, 2] / length_px

    # The part reaches beyond the corners of the turned chip.
    reach = 0.75 * side_px * step + 2
    lowest = centres - reach[:, None]
    highest = centres + reach[:, None] + 1
    image_end = np.array(image_px)
    first = np.clip(lowest, 0, image_end - 1).astype(np.intp)
    last = np.clip(highest, 1, image_end).astype(np.intp)
    last = np.maximum(last, first + 1)

    # The part is reduced, so that bilinear sampling averages all of its pixels.
    extent = last - first
    reduction = np.minimum(1.0, _SHARPNESS / step)[:, None]
    reduced = np.rint(extent * reduction)
    sizes = np.maximum(1, reduced).astype(np.intp)
    ratio = sizes / extent

    # From the chip to the image: a rotation about the centre with the candidate's scale.
    cosine = np.cos(angles)
    sine = np.sin(angles)
    rotations = np.array([[cosine, -sine], [sine, cosine]])
    turn = step[:, None, None] * rotations.transpose(2, 0, 1)
    chip_centre = (side_px / 2, side_px / 2)
    origin = centres - first - turn @ chip_centre
    # From the image to the reduced part.
    linear = turn * ratio[:, :, None]
    translation = origin * ratio
    # These coordinates have pixel centres at +0.5, those of OpenCV at whole numbers.
    translation += linear @ (0.5, 0.5) - 0.5
    matrices = np.concatenate([linear, translation[:, :, None]], axis=2)
    bounds = np.concatenate([first, last], axis=1)
    return _Cuts(bounds, sizes, matrices)


class Weights(NamedTuple):
    """Weights of the terms of the combined logit.

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
        """Combine scores ``[n]`` in [0, 1]; see the class for the terms.

        Args:
            scores: ``[n]`` the detector's scores.
            logits: ``[n]`` the verifier's logits.
            size_odds: ``[n]`` how well the sizes fit, or 0.
        """
        detector = np.asarray(scores, np.float64)
        detector = np.clip(detector, _SCORE_MARGIN, 1 - _SCORE_MARGIN)
        verifier = np.asarray(logits, np.float64)
        size = np.asarray(size_odds, np.float64)
        by_detector = self.detector * np.log(detector / (1 - detector))
        by_verifier = self.verifier * verifier
        total = by_detector + by_verifier + self.bias + self.size * size
        logit = np.clip(total, -_MAX_LOGIT, _MAX_LOGIT)
        return chances_of(logit)


class AuxiliaryModel(LoadedModel, Generic[_CardT]):
    """Network from ``chips [n, c, h, w]`` float32 to outputs with a row for each chip.

    Args:
        path: the ONNX file.
        runtime: how to open it; None for the defaults.

    Attributes:
        named: name of the kind of network, for messages.
        trained_by: module that trains and exports it, for messages.
        chip_shape: channels, rows and columns of a chip.
        outputs: names of the outputs, and the shape of a row of each.
        card_type: type of the model card.
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
    outputs: ClassVar[Mapping[str, tuple[int, ...]]]
    card_type: ClassVar[type[AuxiliaryCard]]

    card: _CardT

    def __init__(self, path: str | Path, *, runtime: Runtime | None = None) -> None:
        self.path = Path(path)
        self.runtime = runtime or Runtime()
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, runtime=self.runtime)
        self._check_contract()
        self.card = read_card(
            self.card_type,
            self.path,
            sha256=models_sha256(file),
            metadata=self._session.get_modelmeta().custom_metadata_map,
        )  # type: ignore[assignment]

    def _check_contract(self) -> None:
        """Check the names of inputs and outputs, and the shape of a chip.

        Raises:
            ModelContractError: the file is another kind of network.
        """
        inputs = self._session.get_inputs()
        outputs = self._session.get_outputs()
        names = [tensor.name for tensor in (*inputs, *outputs)]
        if names == [_INPUT, *self.outputs]:
            chip_shape = tuple(inputs[0].shape[1:])
            if chip_shape == self.chip_shape:
                return
        channels, height, width = self.chip_shape
        raise ModelContractError(
            f"{self.path} has {', '.join(names)}: expected {_INPUT} [n, {channels}, {height}, "
            f"{width}] and {', '.join(self.outputs)}, as {self.trained_by} writes them"
        )

    def predict(self, chips: Chips) -> list[NDArray[np.float64]]:
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
        batch = np.divide(planes, np.float32(255), dtype=np.float32)
        described = f"the {self.named} {self.path} fails on {list(batch.shape)}"
        results = run_session(
            self._session,
            list(self.outputs),
            feeds={_INPUT: batch},
            runtime=self.runtime,
            described=described,
        )
        numbers = [np.asarray(result, np.float64) for result in results]
        self._check_numbers(numbers, len(chips))
        return numbers

    def _check_numbers(self, outputs: Sequence[NDArray[np.float64]], n_chips: int) -> None:
        """Check that the outputs have finite numbers for each chip.

        Raises:
            ModelContractError: they have not.
        """
        expected_shapes = [(n_chips, *shape) for shape in self.outputs.values()]
        shapes = [output.shape for output in outputs]
        are_finite = all(np.isfinite(output).all() for output in outputs)
        if shapes != expected_shapes or not are_finite:
            raise ModelContractError(
                f"the {self.named} {self.path} does not give numbers for each of its chips"
            )


class Verifier(AuxiliaryModel[VerifierCard]):
    """Network from chips of candidates ``[n, 3, 48, 48]`` to the logit of a car, ``logit [n]``."""

    named = "verifier"
    trained_by = "research/training/verifier"
    chip_shape = (3, CHIP_PX, CHIP_PX)
    outputs: ClassVar = {"logit": ()}
    card_type = VerifierCard

    def scored(
        self, pixels: RgbImage, candidates: Objects, *, size_odds: ArrayLike = 0.0
    ) -> Objects:
        """Replace the scores of candidates by the combined scores.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, the tile in which they were found.
            candidates: candidates, in its pixels.
            size_odds: ``[n]`` how well their sizes fit (see ``SceneScalePrior.size_odds``); 0
                without a prior.
        """
        parts = [np.zeros(0)]
        for start in range(0, len(candidates), _BATCH):
            batch = slice(start, start + _BATCH)
            chips = surroundings(pixels, candidates.boxes[batch])
            parts.append(self.logits(chips))
        logits = np.concatenate(parts)
        weights = Weights(*self.card.weights)
        scores = weights.score(candidates.scores, logits, size_odds)
        return Objects(candidates.boxes, scores, candidates.classes)

    def logits(self, chips: Chips) -> NDArray[np.float64]:
        """Predict the logits of cars ``[n]`` from chips ``[n, 48, 48, 3]``."""
        return self.predict(chips)[0]
