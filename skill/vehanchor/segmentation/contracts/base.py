"""Base of all segmenter contracts: inputs, runs and outputs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vehanchor.errors import ModelContractError
from vehanchor.models.runtime import LoadedModel
from vehanchor.models.session import Session, run_session

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window
    from vehanchor.segmentation.prompt import Prompt

MEAN_RGB = np.array([123.675, 116.28, 103.53], dtype=np.float32)  # SAM's and ImageNet's, in 0..255
SD_RGB = np.array([58.395, 57.12, 57.375], dtype=np.float32)
SAM_STRIDE_PX = 16  # of the embedding
DTYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}
_MASK_PER_EMBEDDING = 4  # SAM's mask prompt is four times finer than its embedding
# labels; 1 is a point on the object, 0 one outside it
_TOP_LEFT = 2
_BOTTOM_RIGHT = 3
# number of masks from a decoder with a single-mask output and three for ambiguous prompts
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
        mean_sd: of the encoder's input, in 0..255.
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
    mean_sd: tuple[NDArray[np.float32], NDArray[np.float32]] = MEAN_RGB, SD_RGB

    def __init__(self, encoder: Session, decoder: Session, input_px: int | None) -> None:
        self._encoder = encoder
        self._decoder = decoder
        self._image = encoder.get_inputs()[0]
        self.input_px = input_px or self._found_input_px()
        self._check_image_shape()

    def _found_input_px(self) -> int:
        """Derive the side of the model's square input from the shapes of its graphs."""
        shape = self._image.shape
        sides = [side for side in shape[-2:] if isinstance(side, int)] if len(shape) == 4 else []
        if len(shape) == 3:
            sides = [side for side in shape[:2] if isinstance(side, int)]
        if sides:
            return int(max(sides))
        embedding = self._side(self.embedding)
        prior = self._side("mask_input")
        if embedding is not None and prior in (None, embedding * _MASK_PER_EMBEDDING):
            return embedding * SAM_STRIDE_PX
        if embedding is None and prior is not None:
            return prior * SAM_STRIDE_PX // _MASK_PER_EMBEDDING
        raise ModelContractError(
            f"the encoder's input {self._image.name!r} has shape {shape}, its embedding side "
            f"{embedding} and the mask "
            f"prompt side {prior}: the input size is unknown. Export with fixed shapes, or "
            "write the metadata "
            "vehanchor.input_size_px"
        )

    def _side(self, name: str) -> int | None:
        """Read the last side of an output of the encoder, or an input of the decoder; None if it is not fixed."""
        for item in (*self._encoder.get_outputs(), *self._decoder.get_inputs()):
            if item.name == name and len(item.shape) == 4 and isinstance(item.shape[-1], int):
                return int(item.shape[-1])
        return None

    def _check_image_shape(self) -> None:
        shape = self._image.shape
        fixed = [side for side in shape[-2:] if isinstance(side, int)]
        if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            raise ModelContractError(
                f"the encoder's input {self._image.name!r} has shape {shape}: not [b, 3, h, w]"
            )
        if any(side != self.input_px for side in fixed):
            raise ModelContractError(
                f"the encoder's input {self._image.name!r} has shape {shape}, but the input "
                f"size is {self.input_px} "
                "px: only square inputs can be used"
            )

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Compute the width and height to which a crop is resized before ``predict``: it is stretched to a square."""
        del width_px, height_px
        return self.input_px, self.input_px

    def _prepared(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Convert the resized crop to the encoder's input."""
        mean, sd = self.mean_sd
        normal: NDArray[np.float32] = ((image.astype(np.float32) - mean) / sd).transpose(2, 0, 1)[
            None
        ]
        return normal

    def predict(self, image: NDArray[np.uint8], window: Window, prompt: Prompt) -> MaskLogits:
        """Run encoder and decoder for one prompt.

        Args:
            image: ``[h, w, 3]`` uint8 RGB, the crop resized to ``input_size``.
            window: the crop, pixels of the image.
            prompt: in pixels of the image.

        Raises:
            PromptError: this model cannot read the prompt.
            ModelContractError: the outputs are not masks with scores.
        """
        features = self._run(self._encoder, {self._image.name: self._prepared(image)})
        size = image.shape[1], image.shape[0]
        across = size[0] / window.width_px
        down = size[1] / window.height_px
        seen = prompt.mapped(
            lambda x, y: ((x - window.x_px) * across - 0.5, (y - window.y_px) * down - 0.5)
        )
        feeds = {
            **features,
            **self._no_mask_prompt(),
            "orig_im_size": np.array(size[::-1], np.float32),
        }
        outputs = self._run(self._decoder, {**feeds, **self._feeds(seen)})
        masks, (width, height) = self._masks(outputs, size)
        grid, score = self._chosen(masks, outputs[self.decoder_outputs[1]], prompt)
        rows, columns = grid.shape
        return MaskLogits(
            grid,
            score,
            cells_per_px=(columns / width * across, rows / height * down),
            window=window,
        )

    @abstractmethod
    def _feeds(self, prompt: Prompt) -> dict[str, NDArray[Any]]:
        """Build the decoder's inputs for a prompt in pixel indices of the encoder's picture."""

    def _masks(
        self, outputs: Mapping[str, NDArray[Any]], size: tuple[int, int]
    ) -> tuple[NDArray[Any], tuple[int, int]]:
        """Choose the output with the masks; return it with the width and height of the input that it covers."""
        return outputs[self.decoder_outputs[0]], size

    def _run(self, session: Session, feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Run a session on its inputs, converted to its types; return the outputs by name."""
        inputs = {
            item.name: feeds[item.name].astype(DTYPES[item.type]) for item in session.get_inputs()
        }
        names = [output.name for output in session.get_outputs()]
        shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in inputs.items())
        results = run_session(
            session,
            names,
            feeds=inputs,
            runtime=self.runtime,
            described=f"the {self.name} segmenter fails on {shapes}",
        )
        return dict(zip(names, (np.asarray(result) for result in results), strict=True))

    def _no_mask_prompt(self) -> dict[str, NDArray[Any]]:
        """Build the inputs that mean "no mask prompt"."""
        shapes = {item.name: item.shape for item in self._decoder.get_inputs()}
        fallback = self.input_px * _MASK_PER_EMBEDDING // SAM_STRIDE_PX
        sides = [
            side if isinstance(side, int) else fallback for side in shapes.get("mask_input", [])[2:]
        ]
        return {
            "mask_input": np.zeros((1, 1, *(sides or [fallback] * 2)), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
        }

    def _chosen(
        self, masks: NDArray[Any], scores: NDArray[Any], prompt: Prompt
    ) -> tuple[NDArray[np.float32], float]:
        """Choose one of the masks ``[m, gh, gw]`` by the package's rule; return it with its score."""
        grids = masks.reshape(-1, *masks.shape[-2:])
        flat = np.nan_to_num(scores.reshape(-1).astype(np.float64), nan=0.0)
        if len(grids) != len(flat) or len(grids) == 0 or min(grids.shape[1:]) < 1:
            raise ModelContractError(
                f"the decoder put out masks of shape {list(masks.shape)} and scores of shape "
                f"{list(scores.shape)}: "
                "expected one score a mask"
            )
        index = int(np.argmax(flat))
        if len(flat) == _SINGLE_AND_MULTI:
            unambiguous = prompt.box is not None or len(prompt.points) > 1
            index = 0 if unambiguous else 1 + int(np.argmax(flat[1:]))
        return grids[index].astype(np.float32), float(np.clip(flat[index], 0.0, 1.0))


def corner_prompt(prompt: Prompt) -> tuple[list[tuple[float, float]], list[int]]:
    """Convert a prompt to SAM's points and their labels; the corners of a box have labels 2 and 3."""
    coords: list[tuple[float, float]] = [(x, y) for x, y, _ in prompt.points]
    labels = [int(include) for _, _, include in prompt.points]
    if prompt.box is not None:
        return [prompt.box[:2], prompt.box[2:], *coords], [_TOP_LEFT, _BOTTOM_RIGHT, *labels]
    return coords, labels
