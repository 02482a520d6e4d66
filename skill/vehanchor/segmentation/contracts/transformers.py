"""Contract of SAM 2 and the SAM 3 tracker in the layout of transformers.js (onnx-community).

* Encoder: ``pixel_values`` ``[b, 3, s, s]``, normalised, stretched to the square; SAM 3 (stride 14)
  with mean and sd 0.5.
* Decoder: ``image_embeddings.0 .1 .2, input_points, input_labels, input_boxes`` -> ``pred_masks,
  iou_scores``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.segmentation.contracts.base import SamContract, corner_prompt
from vehanchor.segmentation.prompt import Prompt

if TYPE_CHECKING:
    from vehanchor.models.session import Session
    from vehanchor.segmentation.contracts.base import Tensors

# SAM 3 normalises by a mean and a standard deviation of 0.5, for values 0..1.
_SAM3_LEVEL = np.full(3, 127.5, np.float32)
# Stride of SAM 3's embedding; that of SAM 2 is 16.
_SAM3_STRIDE_PX = 14
_SAM3_INPUT_PX = 1008


class Transformers(SamContract):
    """Contract of SAM 2 and the SAM 3 tracker."""

    name = "transformers"
    described = "SAM 2 or SAM 3 tracker (onnx-community's)"
    encoder_inputs = frozenset({"pixel_values"})
    encoder_outputs = frozenset({f"image_embeddings.{level}" for level in range(3)})
    decoder_inputs = encoder_outputs | {"input_points", "input_labels", "input_boxes"}
    decoder_outputs = "pred_masks", "iou_scores"
    embedding = "image_embeddings.2"

    def __init__(self, encoder: Session, decoder: Session, input_px: int | None) -> None:
        super().__init__(encoder, decoder, input_px)
        # The stride distinguishes SAM 3 from SAM 2; the names are the same.
        side = self._side(self.embedding)
        sam3_input_px = _SAM3_INPUT_PX if side is None else side * _SAM3_STRIDE_PX
        if self.input_px == sam3_input_px:
            self.mean_sd = _SAM3_LEVEL, _SAM3_LEVEL

    def _infer_input_px(self) -> int:
        if self._side(self.embedding) == _SAM3_INPUT_PX // _SAM3_STRIDE_PX:
            return _SAM3_INPUT_PX
        return super()._infer_input_px()

    def _prompt_inputs(self, prompt: Prompt) -> Tensors:
        """Build separate inputs for boxes and points."""
        coords, labels = corner_prompt(Prompt(points=prompt.points))
        corners, _ = corner_prompt(Prompt(box=prompt.box))
        points = np.array(coords, np.float32)
        point_labels = np.array(labels, np.int64)
        boxes = np.array(corners, np.float32)
        return {
            "input_points": points.reshape(1, 1, -1, 2),
            "input_labels": point_labels.reshape(1, 1, -1),
            "input_boxes": boxes.reshape(1, -1, 4),
        }
