"""Oriented-box detector: an ONNX model that runs on one tile, and its model card.

One code path reads the bundled model and any YOLOv8, YOLO11 or YOLO26 OBB file that a user exports
with Ultralytics.
"""

from __future__ import annotations

import copy
import hashlib
import math
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, assert_never

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
from vehanchor.detection.detector_errors import DetectorErrors, read_detector_errors
from vehanchor.detection.verifier import Verifier
from vehanchor.errors import ModelContractError
from vehanchor.models.files import file_cached, models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import BUNDLED_MODELS, auxiliary_model, errors_file, resolve_model

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence
    from typing import Self, TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard

    Tile: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB."""

    DetectorSource: TypeAlias = "Detector | str | os.PathLike[str]"
    """A bundled model's name, the path of an ONNX oriented-box model, or a loaded detector."""

# Grey level of Ultralytics' padding.
_PADDING_LEVEL = 114
# Side of the blank image that reveals the shapes of the outputs, in strides.
_PROBE_STRIDES = 4
# Largest side of a fixed input: 100 times the pixels of YOLO's training images.
_MAX_INPUT_PX = 8192
# Larger angles, in radians, are invalid.
_MAX_ANGLE = 1e4
# Largest number of boxes: so many, and one more for so many pixels. A YOLO with a layer of stride 4
# has one anchor for 12 px.
_MIN_BOX_LIMIT = 4096
_PX_PER_BOX = 8


class TileDetections(NamedTuple):
    """Objects of one tile before non-maximum suppression, in pixels of the tile or of the image.

    Attributes:
        vehicles: boxes with their best vehicle class, even if another class scores higher.
        others: boxes whose best class is not a vehicle class.
        ran_out: whether the model filled all its rows, so that objects may be missing.
    """

    vehicles: Objects
    others: Objects
    ran_out: bool


class PreparedTile:
    """Tile as the model takes it, once: its input has four times the bytes of its pixels.

    Attributes:
        pixels: ``[h, w, 3]`` uint8 RGB.
    """

    def __init__(self, pixels: Tile, batch: NDArray[Any]) -> None:
        """Keep a tile and its input.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB.
            batch: ``[1, 3, H, W]`` in 0..1, padded right and below.
        """
        self.pixels = pixels
        self._batches = [batch]

    def take_batch(self) -> NDArray[Any]:
        """Take the input, whose memory is free after the run."""
        return self._batches.pop()


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
        errors: file of the errors; by default the file beside the detector,
            ``<stem>.errors.toml``. Without one, the defaults of ``DetectorErrors`` are used.
        runtime: how to open the detector and its auxiliary models; None for the defaults.

    Attributes:
        path: the ONNX file.
        card: model card.
        verifier: the verifier, which ``search`` applies; None without one.
        chips: the chip network, which ``search`` applies at its end; None without one.
        runtime: how the detector was opened, and the call that it runs for.
        classes: the caller's classes that count as vehicles; None for the model's own.
        fixed_size: height and width of the model's input, pixels; None if they are free.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not an oriented-box detector of a known layout, or the file
            of its errors is invalid.
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
        errors: str | Path | None = None,
        runtime: Runtime | None = None,
    ) -> None:
        self.path = Path(path)
        self.runtime = runtime or Runtime()
        file = read_model(self.path)
        self._session = open_session(self.path, content=file.content, runtime=self.runtime)
        self.verifier = self._open_verifier(verifier)
        self.chips = self._open_chips(chips)
        self.card = read_detector_card(
            self.path,
            models_sha256(file),
            metadata=self._session.get_modelmeta().custom_metadata_map,
            verifier=self.verifier.card if self.verifier else None,
            chips=self.chips.card if self.chips else None,
            errors=self._read_errors(errors),
        )
        self._input = self._checked_input()
        self._dtype: type[np.floating[Any]] = np.float32
        if self._input.type == "tensor(float16)":
            self._dtype = np.float16
        self.fixed_size = self._fixed_size()
        self._contract = self._recognised_contract()
        self._choose_classes(classes)

    def _choose_classes(self, classes: Sequence[str | int] | None) -> None:
        """Choose the classes that count as vehicles; None for the model's own."""
        try:
            self._vehicle_classes = vehicle_classes(
                self.card.class_names, self._contract.n_classes, classes
            )
        except ModelContractError as error:
            raise ModelContractError(f"{self.path}: {error}") from None
        self.classes = None if classes is None else tuple(classes)

    def with_classes(self, classes: Sequence[str | int]) -> Self:
        """Copy the detector with other classes that count as vehicles; the models are shared.

        Raises:
            InvalidParameterError: the model lacks a class, or ``classes`` is empty.
        """
        other = copy.copy(self)
        other._choose_classes(classes)
        return other

    def _open_verifier(self, path: str | Path | None) -> Verifier | None:
        """Open the verifier at a path, or by default the one beside the detector, if any."""
        path = path if path is not None else auxiliary_model(self.path, "verifier")
        if path is None:
            return None
        return Verifier(path, runtime=self.runtime)

    def _open_chips(self, path: str | Path | None) -> ChipNetwork | None:
        """Open the chip network at a path, or by default the one beside the detector, if any."""
        path = path if path is not None else auxiliary_model(self.path, "chips")
        if path is None:
            return None
        return ChipNetwork(path, runtime=self.runtime)

    def _read_errors(self, path: str | Path | None) -> DetectorErrors | None:
        """Read the errors at a path, or by default beside the detector; None without any."""
        path = path if path is not None else errors_file(self.path)
        if path is None:
            return None
        return read_detector_errors(Path(path))

    def under(self, call: Runtime) -> Self:
        """Bind the detector and its auxiliary models to one call; see ``LoadedModel.under``."""
        bound = super().under(call)
        if bound is self:
            return self
        if self.verifier:
            bound.verifier = self.verifier.under(call)
        if self.chips:
            bound.chips = self.chips.under(call)
        return bound

    def _refuse(self, problem: str) -> ModelContractError:
        """Create the error of a file that is not an oriented-box detector."""
        layouts = " or ".join(kind.layout for kind in CONTRACTS)
        return ModelContractError(
            f"{self.path} is not an oriented-box detector: {problem}. Expected one float input "
            f"[1, 3, h, w] and an output {layouts}, as 'yolo export model=yolo11l-obb.pt "
            "format=onnx' writes it"
        )

    def _checked_input(self) -> Any:
        """Check that the model has one float input ``[batch, 3, height, width]``, and return it."""
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(tensor.name for tensor in inputs)
            raise self._refuse(f"it has {len(inputs)} inputs ({names})")
        (image,) = inputs
        if image.type not in ("tensor(float)", "tensor(float16)"):
            raise self._refuse(f"input {image.name!r} is {image.type}")
        if not _is_image_shape(image.shape):
            raise self._refuse(f"input {image.name!r} has shape {image.shape}")
        return image

    def _fixed_size(self) -> tuple[int, int] | None:
        """Read height and width of the input; None if they are free.

        Raises:
            ModelContractError: the batch is not 1, or the input is too large.
        """
        sides = [_fixed_side(side) for side in self._input.shape]
        batch, _, height, width = sides
        if batch not in (None, 1):
            raise ModelContractError(
                f"{self.path}: batch size is fixed at {batch}; export with batch=1 or dynamic=True"
            )
        if max(height or 0, width or 0) > _MAX_INPUT_PX:
            raise self._refuse(
                f"its input is fixed at {width} x {height} px, more than {_MAX_INPUT_PX} px a side"
            )
        if not height or not width:
            return None
        return height, width

    def _recognised_contract(self) -> DetectorContract:
        """Recognise the contract by the shapes of the outputs."""
        try:
            return recognise_contract(self._output_shapes(), self.card.class_names)
        except ModelContractError as error:
            raise self._refuse(str(error)) from None

    def _output_shapes(self) -> list[tuple[int, ...]]:
        """List the shapes of the outputs; if the file leaves them open, run a blank image."""
        declared = self._session.get_outputs()
        shapes = [tuple(output.shape) for output in declared]
        sides = chain.from_iterable(shape[1:] for shape in shapes)
        if all(isinstance(side, int) for side in sides):
            return shapes
        probe_px = self.card.stride_px * _PROBE_STRIDES
        height, width = self.fixed_size or (probe_px, probe_px)
        blank = np.zeros((1, 3, height, width), dtype=self._dtype)
        try:
            outputs = self._run(blank)
        except ModelContractError as error:
            raise self._refuse(
                f"it does not take a blank {width} x {height} image ({error})"
            ) from None
        return [output.shape for output in outputs]

    def _run(self, batch: NDArray[Any]) -> list[NDArray[Any]]:
        """Run the model on ``[1, 3, H, W]``; return its outputs."""
        outputs = run_session(
            self._session,
            None,
            feeds={self._input.name: batch},
            runtime=self.runtime,
            described=f"the detector {self.path} fails on {list(batch.shape)}",
        )
        return [np.asarray(output) for output in outputs]

    def prepared(self, pixels: Tile) -> PreparedTile:
        """Convert a tile to the model's input.

        Args:
            pixels: ``[h, w, 3]`` uint8 RGB, no larger than the model's fixed input.
        """
        tile = pixels
        height, width = tile.shape[:2]
        full_height, full_width = self._input_size(height, width)
        if (full_height, full_width) != (height, width):
            shape = (full_height, full_width, 3)
            padded = np.full(shape, _PADDING_LEVEL, dtype=np.uint8)
            padded[:height, :width] = tile
            tile = padded
        batch = np.empty((1, 3, full_height, full_width), np.float32)
        # One pass of OpenCV, beside the network; NumPy's conversion delays the network, too.
        for plane, channel in zip(batch[0], cv2.split(tile), strict=True):
            cv2.addWeighted(channel, 1 / 255, channel, 0.0, 0.0, dst=plane, dtype=cv2.CV_32F)
        batch = batch.astype(self._dtype, copy=False)
        return PreparedTile(pixels, batch)

    def _input_size(self, height: int, width: int) -> tuple[int, int]:
        """Compute the size of the model's input for a tile: fixed, or whole strides."""
        if self.fixed_size:
            return self.fixed_size
        stride = self.card.stride_px
        # Floor division of negative numbers rounds the strides up.
        n_down = -(-height // stride)
        n_across = -(-width // stride)
        return n_down * stride, n_across * stride

    def detect_tile(self, tile: PreparedTile, min_score: float) -> TileDetections:
        """Detect objects in one tile, without non-maximum suppression.

        Args:
            tile: the tile; another thread may prepare it while the model runs on the one before.
            min_score: detections below it are dropped.

        Returns:
            Vehicles and other objects with canonical boxes, in tile pixels.
        """
        outputs = self._run(tile.take_batch())
        try:
            vehicles = self._contract.objects(outputs, min_score, self._vehicle_classes)
            others = Objects.joined()
            if self._contract.n_classes != len(self._vehicle_classes):
                best_of_all = self._contract.objects(outputs, min_score)
                is_vehicle = np.isin(best_of_all.classes, self._vehicle_classes)
                others = best_of_all.take(~is_vehicle)
            ran_out = self._contract.ran_out(outputs)
        # The outputs have other shapes than for the blank image.
        except (LookupError, ValueError, TypeError) as error:
            shapes = [str(list(output.shape)) for output in outputs]
            raise ModelContractError(
                f"the detector {self.path} returned outputs of shape {', '.join(shapes)}, which do "
                "not match its layout; export it again"
            ) from error
        return TileDetections(
            self._sane_objects(vehicles, tile.pixels),
            self._sane_objects(others, tile.pixels),
            ran_out,
        )

    def _sane_objects(self, objects: Objects, tile: Tile) -> Objects:
        """Select the objects with possible boxes, and convert these to canonical form.

        A possible box is finite, no larger than the tile and centred in it.

        Raises:
            ModelContractError: there are more boxes than any detector has anchors.
        """
        height, width = tile.shape[:2]
        max_boxes = _MIN_BOX_LIMIT + height * width // _PX_PER_BOX
        if len(objects) > max_boxes:
            raise ModelContractError(
                f"the detector {self.path} returned {len(objects)} boxes for {width} x {height} "
                f"px; at most {max_boxes} fit"
            )
        boxes = objects.boxes
        centres = boxes[:, :2]
        sides = boxes[:, 2:4]
        diagonal = math.hypot(width, height)
        sides_fit = (sides > 0) & (sides <= diagonal)
        centres_fit = (centres >= 0) & (centres <= [width, height])
        is_sane = (
            np.isfinite(boxes).all(axis=1)
            & sides_fit.all(axis=1)
            & centres_fit.all(axis=1)
            & (np.abs(boxes[:, 4]) < _MAX_ANGLE)
        )
        return Objects(
            canonical_boxes(boxes[is_sane]),
            np.clip(objects.scores[is_sane], 0.0, 1.0),
            objects.classes[is_sane],
        )


def _is_image_shape(shape: Sequence[int | str | None]) -> bool:
    """Test whether a shape is ``[batch, 3, height, width]``."""
    if len(shape) != 4:
        return False
    # A side that is not fixed is None or has a name.
    n_channels = shape[1]
    return n_channels in (3, None) or isinstance(n_channels, str)


def _fixed_side(side: int | str | None) -> int | None:
    """Return the length of a side of an input; None if the model leaves it open."""
    if isinstance(side, int):
        return side
    return None


_opened = file_cached(max_models=4)(Detector)


def load_detector(
    path: str | Path,
    runtime: Runtime | None = None,
    *,
    classes: Sequence[str | int] | None = None,
) -> Detector:
    """Open a detector, or return the open one while its files are unchanged; see ``Detector``.

    Args:
        path: the ONNX file.
        runtime: how to open it, and the call that it runs for; None for the defaults.
        classes: as for ``Detector``.

    Returns:
        The detector, shared by all callers with equal arguments.

    Raises:
        ModelError: as ``Detector``.
    """
    file = Path(path)
    runtime = runtime or Runtime()
    detector = _opened(
        file,
        verifier=auxiliary_model(file, "verifier"),
        chips=auxiliary_model(file, "chips"),
        errors=errors_file(file),
        classes=None if classes is None else tuple(classes),
        runtime=runtime.idle,
    )
    return detector.under(runtime)


def open_detector(
    source: DetectorSource | None, classes: Sequence[str | int] | None, runtime: Runtime
) -> Detector:
    """Open a detector.

    Args:
        source: a bundled model's name, a path, or a loaded detector, which keeps its runtime; None
            for the bundled one.
        classes: classes that count as vehicles, also of a loaded detector; None or empty keeps the
            detector's own.
        runtime: how to open it.

    Raises:
        ModelError: it cannot be used.
        InvalidParameterError: the model lacks a class.
    """
    if isinstance(source, Detector):
        if classes:
            return source.with_classes(classes)
        return source
    name = None if source is None else str(source)
    path = resolve_model(name)
    return load_detector(path, runtime, classes=classes or None)


def networks_sha256(card: DetectorCard) -> str:
    """Compute the SHA-256 of the detector and of its auxiliary, scene-scale and court networks.

    A result is stale once one of them, or one of the detector's errors, has changed.
    """
    digest = hashlib.sha256()
    for model in BUNDLED_MODELS:
        match model.role:
            case "detector":
                digest.update(f"{card.sha256}\n".encode())
            case "auxiliary":
                # The card names the checksum of each auxiliary model that this detector has.
                checksum = getattr(card, f"{model.name}_sha256")
                digest.update(f"{checksum}\n".encode())
            case "ruler":
                checksum = models_sha256(read_model(model.path))
                digest.update(checksum.encode())
            case "segmenter":
                # No scale depends on it.
                pass
            case _:
                assert_never(model.role)
    digest.update(f"{card.errors.sha256}\n".encode())
    return digest.hexdigest()
