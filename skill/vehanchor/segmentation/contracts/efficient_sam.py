"""Contract of EfficientSAM's own export.

* Encoder: ``batched_images`` ``[b, 3, h, w]`` 0..1, which its graph resizes to a square.
* Decoder: ``image_embeddings, batched_point_coords, batched_point_labels, orig_im_size`` ->
  ``output_masks, iou_predictions``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import PromptError
from vehanchor.segmentation.contracts.base import SAM_STRIDE_PX, SamContract, corner_prompt

if TYPE_CHECKING:
    from vehanchor.segmentation.contracts.base import Tensors
    from vehanchor.segmentation.prompt import Prompt

# The graph silently drops further points.
_MAX_POINTS = 6
# Input side of the published models, for graphs without fixed shapes.
_INPUT_PX = 1024


class EfficientSam(SamContract):
    """Contract of EfficientSAM."""

    name = "efficient_sam"
    described = "EfficientSAM"
    encoder_inputs = frozenset({"batched_images"})
    encoder_outputs = frozenset({"image_embeddings"})
    decoder_inputs = frozenset(
        {"image_embeddings", "batched_point_coords", "batched_point_labels", "orig_im_size"}
    )
    decoder_outputs = "output_masks", "iou_predictions"
    mean_sd = np.zeros(3, np.float32), np.full(3, 255, np.float32)

    def _infer_input_px(self) -> int:
        side = self._side(self.embedding)
        if side is None:
            return _INPUT_PX
        return side * SAM_STRIDE_PX

    def _prompt_inputs(self, prompt: Prompt) -> Tensors:
        """Build inputs for up to six points on the object, or a box."""
        if not all(include for _, _, include in prompt.points):
            raise PromptError(
                "EfficientSAM reads no points outside the object: leave them out, or use "
                "another model"
            )
        if len(prompt.points) > _MAX_POINTS:
            raise PromptError(
                f"EfficientSAM reads at most {_MAX_POINTS} points, got {len(prompt.points)}"
            )
        coords, labels = corner_prompt(prompt)
        points = np.array(coords, np.float32)
        point_labels = np.array(labels, np.float32)
        return {
            "batched_point_coords": points.reshape(1, 1, -1, 2),
            "batched_point_labels": point_labels.reshape(1, 1, -1),
        }
