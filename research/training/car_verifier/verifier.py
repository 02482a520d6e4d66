"""A verifier for photographs with few candidates: car or not, vehicle type, corners without shadow, length in metres.

Each candidate costs about 6 ms of one core, so the verifier serves up to a dozen. The library does not call it yet.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import canonical_boxes
from vehanchor.detection.verifier import surroundings
from vehanchor.errors import ModelContractError
from vehanchor.models.files import read_model
from vehanchor.models.runtime import Runtime
from vehanchor.models.session import open_session, run_session

if TYPE_CHECKING:
    from numpy.typing import NDArray

CHIP_PX = 96  # rows and columns: three candidate lengths
CHIP_LENGTH_PX = 32.0  # the candidate's length on its chip, along the columns
VEHICLE_TYPES = ("kei", "small", "compact", "saloon", "suv", "pickup", "van", "lorry", "trailer", "other")
_OUTPUTS = {"logit": (), "types": (len(VEHICLE_TYPES),), "box": (5,), "log_length_m": ()}
_MIRRORS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # along and across the candidate's axis
_MARGIN = 1e-4  # scores of 0 and 1 have no log odds
_FUSION = "vehanchor.fusion"  # metadata: three numbers, comma between
_MOST_SHIFT, _MOST_SCALE, _MOST_TURN = 0.3, 0.35, 0.35  # lengths, log, radians: the limits of what training shows


class VerifiedVehicles(NamedTuple):
    """Answers of the verifier, a row for each candidate; means over mirrored chips.

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


class ScoreFusion(NamedTuple):
    """Log odds of a car: ``score * logit(score) + verifier * logit + bias``, fitted on held-out places."""

    score: float
    verifier: float
    bias: float

    def log_odds(self, scores: NDArray[np.float64], logits: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fuse.

        Args:
            scores: ``[n]`` scores of the search without the scene-scale prior.
            logits: ``[n]`` of the verifier.

        Returns:
            ``[n]`` log odds; the prior's log odds of a length are added to them, as to any other score's.
        """
        inside = np.clip(scores, _MARGIN, 1 - _MARGIN)
        return np.asarray(self.score * np.log(inside / (1 - inside)) + self.verifier * logits + self.bias)


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


class CarVerifier:
    """A network from ``chips [n, 3, 96, 96]`` float32 RGB in 0..1 to the four outputs of ``VerifiedVehicles``.

    Args:
        path: the ONNX file.
        runtime: threads and execution providers; None for the defaults.

    Attributes:
        path: the ONNX file.
        fusion: how its logits join the search's scores.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file has other inputs or outputs, or states no fusion.
        ProviderUnavailableError: an execution provider is not installed.
    """

    def __init__(self, path: str | Path, *, runtime: Runtime | None = None) -> None:
        self.path, self.runtime = Path(path), runtime or Runtime()
        content = read_model(self.path).content
        self._session = open_session(self.path, content=content, runtime=self.runtime)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        names = [each.name for each in (*inputs, *outputs)]
        if names != ["chips", *_OUTPUTS] or list(inputs[0].shape[1:]) != [3, CHIP_PX, CHIP_PX]:
            raise ModelContractError(
                f"{self.path} has {', '.join(names)}: expected chips [n, 3, {CHIP_PX}, {CHIP_PX}] and "
                f"{', '.join(_OUTPUTS)}, as research/training/car_verifier writes them"
            )
        stated = self._session.get_modelmeta().custom_metadata_map.get(_FUSION, "")
        try:
            score, weight, bias = (float(number) for number in stated.split(","))
        except ValueError:
            raise ModelContractError(f"{self.path}: the metadata {_FUSION} {stated!r} is not three numbers") from None
        self.fusion = ScoreFusion(score, weight, bias)

    def verify(self, pixels: NDArray[np.uint8], boxes: NDArray[np.float64]) -> VerifiedVehicles:
        """Assess candidates, each on four mirrored chips.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, in the resolution with the most detail.
            boxes: ``[n, 5]`` candidates in their pixels.

        Raises:
            ModelContractError: the network fails or does not answer in finite numbers.
        """
        rows = np.asarray(boxes, np.float64).reshape(-1, 5)
        total = [np.zeros((len(rows), *shape)) for shape in _OUTPUTS.values()]
        if not len(rows):
            return VerifiedVehicles(*total)
        planes = surroundings(pixels, rows, CHIP_PX, CHIP_LENGTH_PX).transpose(0, 3, 1, 2)
        for along, across in _MIRRORS:
            logit, types, box, length = self._answers(planes[:, :, ::across, ::along])
            shifted = np.exp(types - types.max(axis=1, keepdims=True))
            unmirrored = box * (along, across, 1, 1, along * across)
            answers = (logit, shifted / shifted.sum(axis=1, keepdims=True), unmirrored, length)
            for sum_, answer in zip(total, answers, strict=True):
                sum_ += answer / len(_MIRRORS)
        return VerifiedVehicles(*total)

    def _answers(self, planes: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
        batch = np.divide(np.ascontiguousarray(planes), np.float32(255), dtype=np.float32)
        described = f"the car verifier {self.path} fails on {list(batch.shape)}"
        found = run_session(self._session, list(_OUTPUTS), {"chips": batch}, self.runtime, described)
        answers = [np.asarray(each, np.float64) for each in found]
        shapes = [(len(batch), *shape) for shape in _OUTPUTS.values()]
        if [each.shape for each in answers] != shapes or not all(np.isfinite(each).all() for each in answers):
            raise ModelContractError(f"the car verifier {self.path} does not answer in finite numbers for each chip")
        return answers
