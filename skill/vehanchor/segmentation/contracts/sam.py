"""Contract of SAM, MobileSAM and the bundled model: Meta's export of the decoder, samexporter's of the encoder.

* Encoder: ``input_image`` ``[h, w, 3]`` RGB 0..255, or ``[1, 3, s, s]`` normalised; long side s,
  padded right and below.
* Decoder: ``image_embeddings, point_coords, point_labels, mask_input, has_mask_input,
  orig_im_size`` -> ``masks, iou_predictions, low_res_masks``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.segmentation.contracts.base import MEAN_RGB, SD_RGB, SamContract, corner_prompt

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from vehanchor.segmentation.prompt import Prompt

_PADDING = -1  # label of a padding point


class Sam(SamContract):
    """Contract of SAM and MobileSAM."""

    name = "sam"
    described = "SAM or MobileSAM (Meta's or samexporter's export)"
    encoder_inputs = frozenset({"input_image"})
    encoder_outputs = frozenset({"image_embeddings"})
    decoder_inputs = frozenset({"image_embeddings", "point_coords", "point_labels"})
    decoder_outputs = "masks", "iou_predictions"

    def _check_image_shape(self) -> None:
        shape = self._image.shape
        if len(shape) == 3 and (shape[2] == 3 or not isinstance(shape[2], int)):
            return
        super()._check_image_shape()

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Scale the crop so that its long side fills the model's input; sides are rounded half up, as SAM does."""
        scale = self.input_px / max(width_px, height_px)
        return max(1, int(width_px * scale + 0.5)), max(1, int(height_px * scale + 0.5))

    def _feeds(self, prompt: Prompt) -> dict[str, NDArray[Any]]:
        coords, labels = corner_prompt(prompt)
        return {
            "point_coords": np.array([[*coords, (0.0, 0.0)]], np.float32),
            "point_labels": np.array([[*labels, _PADDING]], np.float32),
        }

    def _masks(
        self, outputs: Mapping[str, NDArray[Any]], size: tuple[int, int]
    ) -> tuple[NDArray[Any], tuple[int, int]]:
        coarse = outputs.get("low_res_masks")
        # exports with extra metrics use the name for other outputs
        if coarse is not None and coarse.ndim == 4:
            # Exact and small; some traced exports freeze a landscape shape into "masks".
            return coarse, (self.input_px, self.input_px)
        return super()._masks(outputs, size)

    def _prepared(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Convert the picture to the encoder's input: unpadded if the graph pads, else padded with its zero."""
        height, width = image.shape[:2]
        pixels = image.astype(np.float32)
        below = self.input_px - height
        right = self.input_px - width
        if len(self._image.shape) == 3:
            sides = self._image.shape[:2]
            pads = [
                extra if isinstance(side, int) else 0
                for side, extra in zip(sides, (below, right), strict=True)
            ]
            padded = np.empty((height + pads[0], width + pads[1], 3), np.float32)
            padded[:] = MEAN_RGB
            padded[:height, :width] = pixels
            return padded
        normal = np.zeros((1, 3, self.input_px, self.input_px), np.float32)
        normal[0, :, :height, :width] = ((pixels - MEAN_RGB) / SD_RGB).transpose(2, 0, 1)
        return normal
