"""Contract of SAM, MobileSAM and the bundled model.

The decoder is Meta's export, the encoder samexporter's.

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
    from numpy.typing import NDArray

    from vehanchor.segmentation.contracts.base import RgbImage, Size, Tensors
    from vehanchor.segmentation.prompt import Prompt

# Label of a padding point.
_PADDING = -1


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
        # Pictures with the channels last, or with an unknown number of channels.
        if len(shape) == 3:
            channels = shape[2]
            if channels == 3 or not isinstance(channels, int):
                return
        super()._check_image_shape()

    def input_size(self, width_px: int, height_px: int) -> Size:
        """Compute the size at which the crop's long side fills the model's input.

        Sides are rounded half up, as in SAM.
        """
        factor = self.input_px / max(width_px, height_px)
        width = max(1, int(width_px * factor + 0.5))
        height = max(1, int(height_px * factor + 0.5))
        return width, height

    def _prompt_inputs(self, prompt: Prompt) -> Tensors:
        coords, labels = corner_prompt(prompt)
        coords.append((0.0, 0.0))
        labels.append(_PADDING)
        return {
            "point_coords": np.array([coords], np.float32),
            "point_labels": np.array([labels], np.float32),
        }

    def _mask_output(self, outputs: Tensors, size: Size) -> tuple[NDArray[Any], Size]:
        coarse = outputs.get("low_res_masks")
        # Exports with extra metrics use the name for other outputs.
        if coarse is not None and coarse.ndim == 4:
            # These are exact and small. Some traced exports freeze a landscape shape into "masks".
            return coarse, (self.input_px, self.input_px)
        return super()._mask_output(outputs, size)

    def _encoder_input(self, image: RgbImage) -> NDArray[np.float32]:
        """Convert the resized crop to the encoder's input, padded right and below if needed."""
        height, width = image.shape[:2]
        pixels = image.astype(np.float32)
        if len(self._image.shape) == 4:
            # Padding after normalisation is zero.
            padded = np.zeros((1, 3, self.input_px, self.input_px), np.float32)
            normal = (pixels - MEAN_RGB) / SD_RGB
            padded[0, :, :height, :width] = normal.transpose(2, 0, 1)
            return padded
        # This graph normalises itself, so its padding is the mean. It also pads an axis without a
        # fixed size.
        rows, columns = self._image.shape[:2]
        padded_height = self.input_px if isinstance(rows, int) else height
        padded_width = self.input_px if isinstance(columns, int) else width
        padded = np.empty((padded_height, padded_width, 3), np.float32)
        padded[:] = MEAN_RGB
        padded[:height, :width] = pixels
        return padded
