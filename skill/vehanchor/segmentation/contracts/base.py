"""Base of all segmenter contracts: inputs, runs and outputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np

from vehanchor.errors import ModelContractError
from vehanchor.models.runtime import LoadedModel
from vehanchor.models.session import Session, run_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window
    from vehanchor.segmentation.prompt import Prompt

    RgbImage: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB."""

    Tensors: TypeAlias = dict[str, NDArray[Any]]
    """Arrays by the names of a graph's inputs or outputs."""

    Channels: TypeAlias = NDArray[np.float32]
    """``[3]`` a value for red, green and blue."""

    Size: TypeAlias = tuple[int, int]
    """Width and height, pixels."""

# Normalisation of SAM and ImageNet, for values 0..255.
MEAN_RGB = np.array([123.675, 116.28, 103.53], dtype=np.float32)
SD_RGB = np.array([58.395, 57.12, 57.375], dtype=np.float32)
# Stride of SAM's embedding.
SAM_STRIDE_PX = 16
# Element types of ONNX inputs that the contracts can fill.
DTYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
# SAM's mask prompt is four times finer than its embedding.
_MASK_PER_EMBEDDING = 4
# Labels of a box's corners. 1 is the label of a point on the object, 0 that of one outside it.
_TOP_LEFT = 2
_BOTTOM_RIGHT = 3
# A decoder with so many masks has one for unambiguous prompts, then three for ambiguous ones.
_SINGLE_AND_MULTI = 4


@dataclass(frozen=True, eq=False)
class MaskLogits:
    """Chosen mask as logits on the model's grid.

    Attributes:
        logits: ``[gh, gw]`` float32, the object where > 0.
        score: IoU predicted by the model, 0..1.
        cells_per_px: columns and rows of the grid per pixel of the crop, from the common top left
            corner.
        window: the crop, pixels of the image.
    """

    logits: NDArray[np.float32]
    score: float
    cells_per_px: tuple[float, float]
    window: Window


@dataclass(frozen=True, eq=False)
class EncodedCrop:
    """Crop of the image after the encoder.

    Attributes:
        features: outputs of the encoder by name.
        size: width and height of the crop as the encoder saw it, pixels of its input.
        window: the crop, pixels of the image.
    """

    features: Tensors
    size: Size
    window: Window


class SamContract(LoadedModel, ABC):
    """Contract of an encoder and a decoder; subclasses define inputs and outputs.

    A pair of files fulfils a contract if the encoder has exactly the listed inputs, and both files
    have at least the other listed names.

    Attributes:
        name: short name, for the model card.
        described: description for the error message about unknown files.
        encoder_inputs: all inputs of the encoder.
        encoder_outputs: required outputs of the encoder.
        decoder_inputs: required inputs of the decoder.
        decoder_outputs: required outputs of the decoder: the masks and their scores.
        embedding: name of the coarsest embedding.
        mean_sd: mean and standard deviation of the encoder's input, for values 0..255.
        input_px: side of the model's input, pixels.

    Args:
        encoder: session of the image encoder.
        decoder: session of the prompt encoder and mask decoder.
        input_px: input size from the model's metadata; None if they have none.

    Raises:
        ModelContractError: the size of the model's input is unknown, or not supported.
    """

    name: ClassVar[str]
    described: ClassVar[str]
    encoder_inputs: ClassVar[frozenset[str]]
    encoder_outputs: ClassVar[frozenset[str]]
    decoder_inputs: ClassVar[frozenset[str]]
    decoder_outputs: ClassVar[tuple[str, str]]
    embedding: ClassVar[str] = "image_embeddings"
    mean_sd: tuple[Channels, Channels] = MEAN_RGB, SD_RGB

    def __init__(self, encoder: Session, decoder: Session, input_px: int | None) -> None:
        self._encoder = encoder
        self._decoder = decoder
        self._image = encoder.get_inputs()[0]
        self.input_px = input_px or self._infer_input_px()
        self._check_image_shape()

    def _infer_input_px(self) -> int:
        """Derive the side of the model's square input from the shapes of its graphs."""
        shape = self._image.shape
        sides: list[int] = []
        if len(shape) == 4:
            sides = _fixed(shape[-2:])
        elif len(shape) == 3:
            sides = _fixed(shape[:2])
        if sides:
            return max(sides)
        # The encoder takes any size. The side of the embedding or of the mask prompt gives the
        # input by their strides, unless the two contradict each other.
        embedding = self._side(self.embedding)
        mask_prompt = self._side("mask_input")
        if embedding is not None:
            fitting_mask_prompt = embedding * _MASK_PER_EMBEDDING
            if mask_prompt in (None, fitting_mask_prompt):
                return embedding * SAM_STRIDE_PX
        if embedding is None and mask_prompt is not None:
            return mask_prompt * SAM_STRIDE_PX // _MASK_PER_EMBEDDING
        raise ModelContractError(
            f"the encoder's input {self._image.name!r} has shape {shape}, its embedding side "
            f"{embedding} and the mask prompt side {mask_prompt}: the input size is unknown. "
            "Export with fixed shapes, or write the metadata vehanchor.input_size_px"
        )

    def _side(self, name: str) -> int | None:
        """Return the last side of the named tensor of the graphs; None if it is not fixed."""
        outputs = self._encoder.get_outputs()
        inputs = self._decoder.get_inputs()
        for item in (*outputs, *inputs):
            if item.name != name or len(item.shape) != 4:
                continue
            side = item.shape[-1]
            if isinstance(side, int):
                return side
        return None

    def _check_image_shape(self) -> None:
        """Check the encoder's input.

        Raises:
            ModelContractError: it is not a square picture with three planes.
        """
        shape = self._image.shape
        described = f"the encoder's input {self._image.name!r} has shape {shape}"
        # An unknown number of planes may be three.
        n_planes = _fixed(shape[1:2])
        if len(shape) != 4 or n_planes not in ([], [3]):
            raise ModelContractError(f"{described}: not [b, 3, h, w]")
        sides = _fixed(shape[-2:])
        if any(side != self.input_px for side in sides):
            raise ModelContractError(
                f"{described}, but the input size is {self.input_px} px: only square inputs can "
                "be used"
            )

    def input_size(self, width_px: int, height_px: int) -> Size:
        """Compute the width and height to which a crop is resized before ``encode``.

        The default is a square, to which the crop is stretched.
        """
        del width_px, height_px
        return self.input_px, self.input_px

    def _encoder_input(self, image: RgbImage) -> NDArray[np.float32]:
        """Convert the resized crop to the encoder's input."""
        mean, sd = self.mean_sd
        pixels = image.astype(np.float32)
        normal: NDArray[np.float32] = (pixels - mean) / sd
        return normal.transpose(2, 0, 1)[None]

    def encode(self, image: RgbImage, window: Window) -> EncodedCrop:
        """Run the encoder, whose features serve any number of prompts.

        Args:
            image: ``[h, w, 3]`` uint8 RGB, the crop resized to ``input_size``.
            window: the crop, pixels of the image.
        """
        pixels = self._encoder_input(image)
        features = self._run(self._encoder, {self._image.name: pixels})
        height, width = image.shape[:2]
        return EncodedCrop(features, (width, height), window)

    def decode(self, crop: EncodedCrop, prompt: Prompt) -> MaskLogits:
        """Run the decoder for one prompt.

        Args:
            crop: the encoded crop.
            prompt: prompt in pixels of the image.

        Raises:
            PromptError: this model cannot read the prompt.
            ModelContractError: the outputs are not masks with scores.
        """
        width, height = crop.size
        window = crop.window
        across = width / window.width_px
        down = height / window.height_px

        def in_input(x: float, y: float) -> tuple[float, float]:
            # The graphs take indices of pixels and add half a pixel.
            input_x = (x - window.x_px) * across
            input_y = (y - window.y_px) * down
            return input_x - 0.5, input_y - 0.5

        decoder_inputs = {
            **crop.features,
            **self._no_mask_prompt(),
            "orig_im_size": np.array([height, width], np.float32),
            **self._prompt_inputs(prompt.mapped(in_input)),
        }
        outputs = self._run(self._decoder, decoder_inputs)

        masks, covered_size = self._mask_output(outputs, (width, height))
        scores = outputs[self.decoder_outputs[1]]
        grid, score = self._choose_mask(masks, scores, prompt)
        # The grid covers the input, or the input with its padding.
        rows, columns = grid.shape
        covered_width, covered_height = covered_size
        cells_across = columns / covered_width * across
        cells_down = rows / covered_height * down
        return MaskLogits(grid, score, cells_per_px=(cells_across, cells_down), window=window)

    @abstractmethod
    def _prompt_inputs(self, prompt: Prompt) -> Tensors:
        """Build the decoder's inputs for a prompt in pixel indices of the encoder's picture."""

    def _mask_output(self, outputs: Tensors, size: Size) -> tuple[NDArray[Any], Size]:
        """Choose the output with the masks.

        Args:
            outputs: outputs of the decoder by name.
            size: width and height of the resized crop.

        Returns:
            The masks, and the width and height of the input that they cover.
        """
        return outputs[self.decoder_outputs[0]], size

    def _run(self, session: Session, feeds: Tensors) -> Tensors:
        """Run a session on its inputs, converted to its types; return the outputs by name."""
        inputs = {}
        for item in session.get_inputs():
            dtype = DTYPES[item.type]
            inputs[item.name] = feeds[item.name].astype(dtype)
        names = [output.name for output in session.get_outputs()]
        shapes = [f"{name} {list(value.shape)}" for name, value in inputs.items()]
        results = run_session(
            session,
            names,
            feeds=inputs,
            runtime=self.runtime,
            described=f"the {self.name} segmenter fails on {', '.join(shapes)}",
        )
        arrays = [np.asarray(result) for result in results]
        return dict(zip(names, arrays, strict=True))

    def _no_mask_prompt(self) -> Tensors:
        """Build the inputs that mean "no mask prompt"."""
        fallback = self.input_px * _MASK_PER_EMBEDDING // SAM_STRIDE_PX
        sides = [fallback, fallback]
        for item in self._decoder.get_inputs():
            if item.name == "mask_input" and len(item.shape) > 2:
                sides = [side if isinstance(side, int) else fallback for side in item.shape[2:]]
        return {
            "mask_input": np.zeros((1, 1, *sides), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
        }

    def _choose_mask(
        self, masks: NDArray[Any], scores: NDArray[Any], prompt: Prompt
    ) -> tuple[NDArray[np.float32], float]:
        """Choose one of the masks ``[..., m, gh, gw]`` by the package's rule.

        Returns:
            The logits ``[gh, gw]`` and the score, 0..1.
        """
        grids = masks.reshape(-1, *masks.shape[-2:])
        flat_scores = scores.reshape(-1).astype(np.float64)
        flat_scores = np.nan_to_num(flat_scores, nan=0.0)
        n_masks = len(grids)
        if n_masks != len(flat_scores) or grids.size == 0:
            raise ModelContractError(
                f"the decoder returned masks of shape {list(masks.shape)} and scores of shape "
                f"{list(scores.shape)}: expected one score per mask"
            )
        is_unambiguous = prompt.box is not None or len(prompt.points) > 1
        if n_masks != _SINGLE_AND_MULTI:
            index = int(np.argmax(flat_scores))
        elif is_unambiguous:
            index = 0
        else:
            index = 1 + int(np.argmax(flat_scores[1:]))
        score = float(np.clip(flat_scores[index], 0.0, 1.0))
        return grids[index].astype(np.float32), score


def _fixed(sides: Sequence[int | str | None]) -> list[int]:
    """Return the sides of an ONNX shape that are numbers; a name or None means any size."""
    return [side for side in sides if isinstance(side, int)]


def corner_prompt(prompt: Prompt) -> tuple[list[tuple[float, float]], list[int]]:
    """Convert a prompt to SAM's points and their labels; the corners of a box come first."""
    coords: list[tuple[float, float]] = []
    labels: list[int] = []
    if prompt.box is not None:
        x1, y1, x2, y2 = prompt.box
        coords = [(x1, y1), (x2, y2)]
        labels = [_TOP_LEFT, _BOTTOM_RIGHT]
    for x, y, include in prompt.points:
        coords.append((x, y))
        labels.append(int(include))
    return coords, labels
