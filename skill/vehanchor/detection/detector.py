"""Oriented-box detector: an ONNX model that runs on one tile, and its model card.

One code path reads the bundled model and any YOLOv8, YOLO11 or YOLO26 OBB file that a user exports
with Ultralytics.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from vehanchor.detection.boxes import canonical_boxes
from vehanchor.detection.card import read_detector_card
from vehanchor.detection.chips import ChipNetwork
from vehanchor.detection.contracts import (
    CONTRACTS,
    DetectorContract,
    recognise_contract,
    vehicle_classes,
)
from vehanchor.detection.detections import Objects
from vehanchor.detection.verifier import Verifier
from vehanchor.errors import ModelContractError
from vehanchor.models.files import file_cached, models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import COURTS, SCENE_SCALE, auxiliary_model

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard

_PADDING_LEVEL = 114  # grey level of Ultralytics' padding
_ANGLE_LIMIT = 1e4  # radians; larger angles are invalid
_MAX_INPUT_PX = 8192  # of a fixed input: 100 times the pixels of YOLO's training images
_PX_PER_BOX = 8  # a YOLO with a layer of stride 4 has one anchor for 12 px
_LEAST_BOXES = 4096
_PROBE_STRIDES = 4  # side of the blank image that reveals the outputs' shapes, in strides


class TileDetections(NamedTuple):
    """Objects of one tile before non-maximum suppression, in tile pixels.

    Attributes:
        vehicles: boxes with their best vehicle class, even if another class scores higher.
        others: boxes whose best class is not a vehicle class.
        ran_out: whether the model filled all its rows, so that objects may be missing.
    """

    vehicles: Objects
    others: Objects
    ran_out: bool


class PreparedTile(NamedTuple):
    """Tile as the model takes it.

    Attributes:
        pixels: ``[h, w, 3]`` uint8 RGB.
        batch: ``[1, 3, H, W]`` in 0..1, padded right and below.
    """

    pixels: NDArray[np.uint8]
    batch: NDArray[Any]


class Detector(LoadedModel):
    """Oriented-box vehicle detector with its model card and auxiliary models.

    Args:
        path: the ONNX file.
        classes: class names (in either spelling) or indices that count as vehicles; by default
            "small vehicle", else "car" or "vehicle", else the only class under any name.
        verifier: file of the verifier; by default the file beside the detector,
            ``<stem>.verifier.onnx`` (the bundled one for a bundled detector). Without one, the
            detector's scores are used unchanged.
        chips: file of the chip network; by default the file beside the detector,
            ``<stem>.chips.onnx``. Without one, the detector's boxes are used unchanged.
        runtime: how to open the detector and its auxiliary models; None for the defaults.

    Attributes:
        path: the ONNX file.
        card: model card.
        verifier: the verifier, which ``search`` applies; None without one.
        chips: the chip network, which ``search`` applies at its end; None without one.
        runtime: how the detector was opened, and the call that it runs for.
        fixed_size: height and width of the model's input, pixels; None if they are free.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not an oriented-box detector of a known layout.
        ProviderUnavailableError: an execution provider is not installed.
        InvalidParameterError: bad ``classes``.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        classes: Sequence[str | int] | None = None,
        verifier: str | Path | None = None,
        chips: str | Path | None = None,
        runtime: Runtime | None = None,
    ) -> None:
        self.path = Path(path)
        self.runtime = runtime or Runtime()
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, runtime=self.runtime)
        verifier_path = verifier if verifier is not None else auxiliary_model(self.path, "verifier")
        self.verifier = (
            None if verifier_path is None else Verifier(verifier_path, runtime=self.runtime)
        )
        chips_path = chips if chips is not None else auxiliary_model(self.path, "chips")
        self.chips = None if chips_path is None else ChipNetwork(chips_path, runtime=self.runtime)
        self.card = read_detector_card(
            self.path,
            models_sha256(file),
            metadata=self._session.get_modelmeta().custom_metadata_map,
            verifier=None if self.verifier is None else self.verifier.card,
            chips=None if self.chips is None else self.chips.card,
        )
        self._input = self._checked_input()
        self._dtype = np.float16 if self._input.type == "tensor(float16)" else np.float32
        self.fixed_size = self._fixed_size()
        self._contract = self._recognised_contract()
        try:
            self._vehicle_classes = vehicle_classes(
                self.card.class_names, self._contract.n_classes, classes
            )
        except ModelContractError as error:
            raise ModelContractError(f"{self.path}: {error}") from None

    def under(self, call: Runtime) -> Self:
        """Bind the detector and its auxiliary models to one call; see ``LoadedModel.under``."""
        bound = super().under(call)
        if bound is not self:
            bound.verifier = self.verifier and self.verifier.under(call)
            bound.chips = self.chips and self.chips.under(call)
        return bound

    def _refuse(self, found: str) -> ModelContractError:
        outputs = " or ".join(kind.layout for kind in CONTRACTS)
        return ModelContractError(
            f"{self.path} is not an oriented-box detector: {found}. Expected one float input "
            "[1, 3, h, w] and an "
            f"output {outputs}, as 'yolo export model=yolo11l-obb.pt format=onnx' writes it"
        )

    def _checked_input(self) -> Any:
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise self._refuse(f"it has {len(inputs)} inputs ({', '.join(i.name for i in inputs)})")
        first = inputs[0]
        if first.type not in ("tensor(float)", "tensor(float16)"):
            raise self._refuse(f"input {first.name!r} is {first.type}")
        if len(first.shape) != 4 or (
            first.shape[1] not in (3, None) and not isinstance(first.shape[1], str)
        ):
            raise self._refuse(f"input {first.name!r} has shape {first.shape}")
        return first

    def _fixed_size(self) -> tuple[int, int] | None:
        batch, _, height, width = (
            side if isinstance(side, int) else None for side in self._input.shape
        )
        if batch not in (None, 1):
            raise ModelContractError(
                f"{self.path}: batch size is fixed at {batch}; export with batch=1 or dynamic=True"
            )
        if max(height or 0, width or 0) > _MAX_INPUT_PX:
            raise self._refuse(
                f"its input is fixed at {width} x {height} px, more than {_MAX_INPUT_PX} px a side"
            )
        return (height, width) if height and width else None

    def _recognised_contract(self) -> DetectorContract:
        """Recognise the contract by the outputs' shapes; if these are symbolic, run a blank image to get them."""
        shapes = [tuple(output.shape) for output in self._session.get_outputs()]
        if not all(isinstance(side, int) for shape in shapes for side in shape[1:]):
            height, width = self.fixed_size or (self.card.stride_px * _PROBE_STRIDES,) * 2
            try:
                outputs = self._run(np.zeros((1, 3, height, width), dtype=self._dtype))
            except ModelContractError as error:
                raise self._refuse(
                    f"it does not take a blank {width} x {height} image ({error})"
                ) from None
            shapes = [output.shape for output in outputs]
        try:
            return recognise_contract(shapes, self.card.class_names)
        except ModelContractError as error:
            raise self._refuse(str(error)) from None

    def _run(self, batch: NDArray[Any]) -> list[NDArray[Any]]:
        described = f"the detector {self.path} fails on {list(batch.shape)}"
        outputs = run_session(
            self._session,
            None,
            feeds={self._input.name: batch},
            runtime=self.runtime,
            described=described,
        )
        return [np.asarray(output) for output in outputs]

    def prepared(self, pixels: NDArray[np.uint8]) -> PreparedTile:
        """Convert a tile ``[h, w, 3]`` uint8 RGB, no larger than the model's fixed input, to the model's input."""
        tile = pixels
        height, width = tile.shape[:2]
        stride = self.card.stride_px
        full_h, full_w = self.fixed_size or (
            -(-side // stride) * stride for side in (height, width)
        )
        if (full_h, full_w) != (height, width):
            padded = np.full((full_h, full_w, 3), _PADDING_LEVEL, dtype=np.uint8)
            padded[:height, :width] = tile
            tile = padded
        batch = np.empty((1, 3, full_h, full_w), dtype=self._dtype)
        for plane, channel in zip(batch[0], cv2.split(tile), strict=True):
            np.multiply(channel, np.float32(1 / 255), out=plane, casting="unsafe")
        return PreparedTile(pixels, batch)

    def detect_tile(self, tile: PreparedTile, min_score: float) -> TileDetections:
        """Detect objects in one tile, without non-maximum suppression.

        Args:
            tile: the tile; another thread may prepare it while the model runs on the one before.
            min_score: detections below it are dropped.

        Returns:
            Vehicles and other objects with canonical boxes, in tile pixels.
        """
        outputs = self._run(tile.batch)
        try:
            vehicles = self._contract.objects(outputs, min_score, self._vehicle_classes)
            others = Objects.joined()
            if self._contract.n_classes != len(self._vehicle_classes):
                anything = self._contract.objects(outputs, min_score)
                others = anything.take(~np.isin(anything.classes, self._vehicle_classes))
            ran_out = self._contract.ran_out(outputs)
        # other shapes than for the blank image
        except (LookupError, ValueError, TypeError) as error:
            shapes = ", ".join(str(list(output.shape)) for output in outputs)
            raise ModelContractError(
                f"the detector {self.path} puts out {shapes}, no layout of its"
            ) from error
        return TileDetections(
            self._checked(vehicles, tile.pixels), self._checked(others, tile.pixels), ran_out
        )

    def _checked(self, found: Objects, tile: NDArray[np.uint8]) -> Objects:
        """Select the boxes that are no larger than a tile and centred in it, and convert them to canonical form.

        Raises:
            ModelContractError: there are more boxes than any detector has anchors.
        """
        height, width = tile.shape[:2]
        most = _LEAST_BOXES + height * width // _PX_PER_BOX
        if len(found) > most:
            raise ModelContractError(
                f"the detector {self.path} puts out {len(found)} boxes for {width} x {height} "
                f"px: at most {most} have "
                "place there"
            )
        boxes = found.boxes
        sane = (
            np.isfinite(boxes).all(axis=1)
            & (boxes[:, 2:4] > 0).all(axis=1)
            & (np.abs(boxes[:, 4]) < _ANGLE_LIMIT)
        )
        sane &= (boxes[:, 2:4] <= math.hypot(width, height)).all(axis=1)
        sane &= ((boxes[:, :2] >= 0) & (boxes[:, :2] <= [width, height])).all(axis=1)
        return Objects(
            canonical_boxes(boxes[sane]), np.clip(found.scores[sane], 0.0, 1.0), found.classes[sane]
        )


_opened = file_cached(max_models=4)(Detector)


def load_detector(path: str | Path, runtime: Runtime | None = None) -> Detector:
    """Open a detector, or return the open one while its files are unchanged; see ``Detector``.

    Args:
        path: the ONNX file.
        runtime: how to open it, and the call that it runs for; None for the defaults.

    Returns:
        The detector, shared by all callers with equal arguments.

    Raises:
        ModelError: as ``Detector``.
    """
    file = Path(path)
    chosen = runtime or Runtime()
    verifier = auxiliary_model(file, "verifier")
    chips = auxiliary_model(file, "chips")
    return _opened(file, verifier=verifier, chips=chips, runtime=chosen.idle).under(chosen)


def networks_sha256(card: DetectorCard) -> str:
    """SHA-256 of the detector and of its auxiliary, scene-scale and court networks.

    A result is stale once one of them has changed.
    """
    digest = hashlib.sha256()
    for checksum in (card.sha256, card.verifier_sha256, card.chips_sha256):
        digest.update(f"{checksum}\n".encode())
    for path in (SCENE_SCALE, COURTS):
        digest.update(models_sha256(read_model(path)).encode())
    return digest.hexdigest()
