"""Contract of SAM 2 and 2.1 in samexporter's layout.

* Encoder: ``image`` ``[1, 3, s, s]``, normalised, stretched to the square.
* Decoder: ``image_embed, high_res_feats_0, high_res_feats_1`` and SAM's other inputs -> ``masks, iou_predictions``.
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

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.segmentation.prompt import Prompt


class Sam2(StretchedContract):
    """Contract of SAM 2 and 2.1."""

    name = "sam2"
    described = "SAM 2 (samexporter's)"
    encoder_inputs = frozenset({"image"})
    encoder_outputs = frozenset({"image_embed", "high_res_feats_0", "high_res_feats_1"})
    decoder_inputs = frozenset({"image_embed", "high_res_feats_0", "high_res_feats_1", "point_coords", "point_labels"})
    decoder_outputs = frozenset({"masks", "iou_predictions"})

    def _embedding_side(self) -> int | None:
        name = "image_embed"
        return fixed_side(self._encoder.get_outputs(), name) or fixed_side(self._decoder.get_inputs(), name)

    def decode(self, encoding: Encoding, prompt: Prompt) -> MaskLogits:
        """Decode without a padding point; see ``SamContract.decode``."""
        crop_size = encoding.crop_size
        coords, labels = corner_prompt(prompt, self._scale(crop_size), shift=0.5)  # this graph adds the padding point
        outputs = self._run(
            self._decoder,
            {
                **encoding.outputs,
                "point_coords": np.array([coords], np.float32),
                "point_labels": np.array([labels], np.float32),
                "orig_im_size": np.array([self.input_px, self.input_px], np.float32),
                **self._no_mask_prompt(),
            },
        )
        return self._covering(*self._chosen(outputs["masks"], outputs["iou_predictions"], prompt), crop_size)

    def _prepared(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        normal: NDArray[np.float32] = ((image.astype(np.float32) - MEAN_RGB) / SD_RGB).transpose(2, 0, 1)[None]
        return normal
