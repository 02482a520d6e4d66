"""Contract of EfficientSAM's own export, which resizes any input in its graph.

* Encoder: ``batched_images`` ``[b, 3, h, w]`` 0..1.
* Decoder: ``image_embeddings, batched_point_coords, batched_point_labels, orig_im_size`` -> ``output_masks,
  iou_predictions``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import ModelContractError, PromptError
from vehanchor.segmentation.contracts.base import SAM_STRIDE_PX, Encoding, SamContract, corner_prompt

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.segmentation.prompt import Prompt

_MAX_POINTS = 6  # the graph silently drops further points
_INPUT_PX = 1024


class EfficientSam(SamContract):
    """Contract of EfficientSAM."""

    name = "efficient_sam"
    described = "EfficientSAM"
    encoder_inputs = frozenset({"batched_images"})
    encoder_outputs = frozenset({"image_embeddings"})
    decoder_inputs = frozenset({"image_embeddings", "batched_point_coords", "batched_point_labels", "orig_im_size"})
    decoder_outputs = "output_masks", "iou_predictions"
    mean_sd = np.zeros(3, np.float32), np.full(3, 255, np.float32)

    def _found_input_px(self) -> int:
        side = self._embedding_side()
        return _INPUT_PX if side is None else side * SAM_STRIDE_PX

    def _check_image_shape(self) -> None:
        if len(self._image.shape) != 4:
            raise ModelContractError(
                f"the encoder's input {self._image.name!r} has shape {self._image.shape}: not [b, 3, h, w]"
            )

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Compute the size of the crop reduced to the model's input, but never enlarged."""
        height, width = self._image.shape[2:]
        if isinstance(height, int) and isinstance(width, int):
            return width, height
        scale = min(1.0, self.input_px / max(width_px, height_px))  # the graph enlarges small crops
        return max(1, round(width_px * scale)), max(1, round(height_px * scale))

    def _feeds(self, encoding: Encoding, prompt: Prompt, scale: tuple[float, float]) -> dict[str, NDArray[Any]]:
        """Build inputs for up to six points on the object, or a box."""
        if not all(include for _, _, include in prompt.points):
            raise PromptError("EfficientSAM reads no points outside the object: leave them out, or use another model")
        if len(prompt.points) > _MAX_POINTS:
            raise PromptError(f"EfficientSAM reads at most {_MAX_POINTS} points, got {len(prompt.points)}")
        width, height = encoding.size
        # The graph scales the coordinates to its input and then adds half an input pixel.
        half = 0.5 / self.input_px
        coords, labels = corner_prompt(prompt, scale, shift=(half * width, half * height))
        return {
            "image_embeddings": encoding.outputs["image_embeddings"],
            "batched_point_coords": np.array(coords, np.float32).reshape(1, 1, -1, 2),
            "batched_point_labels": np.array(labels, np.float32).reshape(1, 1, -1),
            "orig_im_size": np.array([height, width], np.int64),
        }
