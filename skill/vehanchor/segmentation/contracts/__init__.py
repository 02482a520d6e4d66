"""The promptable segmenters that users have as ONNX files, each told by the names of its inputs and outputs.

One class a file, all in ``CONTRACTS`` (registry.py): a new kind is one file and one place there.

Coordinates. Here a crop's first pixel spans 0 to 1. All these graphs add half a pixel of the model's input to the
coordinates they are given (SAM speaks of pixel indices), so each contract takes that half off.

Which of several masks. A box, or two points and more, say what is meant: then a decoder that has a single-mask output
(four masks, the first is it) gives that one, as SAM's own predictor does. One point alone may mean a part or the whole:
then, and for decoders without that output (three masks), the mask that the model itself scores highest. SAM's padding
point is always added, which makes decoders exported with ``--return-single-mask`` choose by the same rule.
"""

from __future__ import annotations

from vehanchor.segmentation.contracts.base import Encoding, MaskLogits, SamContract
from vehanchor.segmentation.contracts.registry import CONTRACTS, recognise_contract

__all__ = ["CONTRACTS", "Encoding", "MaskLogits", "SamContract", "recognise_contract"]
