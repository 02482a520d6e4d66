"""Contract of SAM 2 and 2.1 in samexporter's layout.

* Encoder: ``image`` ``[1, 3, s, s]``, normalised, stretched to the square.
* Decoder: ``image_embed, high_res_feats_0, high_res_feats_1`` and SAM's other inputs -> ``masks,
  iou_predictions``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.segmentation.contracts.base import SamContract, corner_prompt

if TYPE_CHECKING:
    from vehanchor.segmentation.contracts.base import Tensors
    from vehanchor.segmentation.prompt import Prompt


class Sam2(SamContract):
    """Contract of SAM 2 and 2.1."""

    name = "sam2"
    described = "SAM 2 (samexporter's)"
    encoder_inputs = frozenset({"image"})
    encoder_outputs = frozenset({"image_embed", "high_res_feats_0", "high_res_feats_1"})
    decoder_inputs = encoder_outputs | {"point_coords", "point_labels"}
    decoder_outputs = "masks", "iou_predictions"
    embedding = "image_embed"

    def _prompt_inputs(self, prompt: Prompt) -> Tensors:
        # This graph adds the padding point itself.
        coords, labels = corner_prompt(prompt)
        return {
            "point_coords": np.array([coords], np.float32),
            "point_labels": np.array([labels], np.float32),
        }
