"""Contract of SAM 2 and the SAM 3 tracker in the layout of transformers.js (onnx-community).

* Encoder: ``pixel_values`` ``[b, 3, s, s]``, normalised, stretched to the square; SAM 3 (stride 14) with mean and sd
  0.5.
* Decoder: ``image_embeddings.0 .1 .2, input_points, input_labels, input_boxes`` -> ``pred_masks, iou_scores``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.segmentation.contracts.base import (
    MEAN_RGB,
    SD_RGB,
    Encoding,
    MaskLogits,
    StretchedContract,
    corner_prompt,
    fixed_side,
)
from vehanchor.segmentation.prompt import Prompt

if TYPE_CHECKING:
    from numpy.typing import NDArray


_SAM3_LEVEL = np.float32(127.5)  # SAM 3: mean and sd 0.5 of 0..1
_SAM3_STRIDE_PX = 14  # of its embedding
_SAM3_INPUT_PX = 1008


class Transformers(StretchedContract):
    """Contract of SAM 2 and the SAM 3 tracker."""

    name = "transformers"
    described = "SAM 2 or SAM 3 tracker (onnx-community's)"
    encoder_inputs = frozenset({"pixel_values"})
    encoder_outputs = frozenset({f"image_embeddings.{level}" for level in range(3)})
    decoder_inputs = encoder_outputs | {"input_points", "input_labels", "input_boxes"}
    decoder_outputs = frozenset({"pred_masks", "iou_scores"})

    def _embedding_side(self) -> int | None:
        name = "image_embeddings.2"
        return fixed_side(self._encoder.get_outputs(), name) or fixed_side(self._decoder.get_inputs(), name)

    def _found_input_px(self) -> int:
        if self._embedding_side() == _SAM3_INPUT_PX // _SAM3_STRIDE_PX:
            return _SAM3_INPUT_PX
        return super()._found_input_px()

    def _is_sam3(self) -> bool:
        side = self._embedding_side()
        return self.input_px == (_SAM3_INPUT_PX if side is None else side * _SAM3_STRIDE_PX)

    def decode(self, encoding: Encoding, prompt: Prompt) -> MaskLogits:
        """Decode with separate inputs for boxes and points; see ``SamContract.decode``."""
        crop_size = encoding.crop_size
        scale = self._scale(crop_size)
        coords, labels = corner_prompt(Prompt(points=prompt.points), scale, shift=0.5)
        corners, _ = corner_prompt(Prompt(box=prompt.box), scale, shift=0.5)
        outputs = self._run(
            self._decoder,
            {
                **encoding.outputs,
                "input_points": np.array(coords, np.float32).reshape(1, 1, -1, 2),
                "input_labels": np.array(labels, np.int64).reshape(1, 1, -1),
                "input_boxes": np.array(corners, np.float32).reshape(1, -1, 4),
            },
        )
        return self._covering(*self._chosen(outputs["pred_masks"], outputs["iou_scores"], prompt), crop_size)

    def _prepared(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        mean, sd = (_SAM3_LEVEL, _SAM3_LEVEL) if self._is_sam3() else (MEAN_RGB, SD_RGB)
        normal: NDArray[np.float32] = ((image.astype(np.float32) - mean) / sd).transpose(2, 0, 1)[None]
        return normal
