"""Contracts of promptable segmenters in ONNX files, recognised by the names of their inputs and outputs.

To add one, write a file with one class and add the class to ``CONTRACTS`` (registry.py).

Coordinates: a crop's first pixel spans 0 to 1. All these graphs take pixel indices, as SAM does, and add half a pixel
of the model's input. Each contract therefore subtracts that half.

Choice of the mask: a box, or two and more points, is unambiguous. A decoder with a single-mask output (the first of
four masks) then gives that one, as SAM's own predictor does. One point may mean a part or the whole. Then, and for
decoders with three masks, the mask with the highest score is chosen. SAM's padding point is always added, so that
decoders exported with ``--return-single-mask`` choose by the same rule.
"""

from __future__ import annotations

from vehanchor.segmentation.contracts.base import Encoding, MaskLogits, SamContract
from vehanchor.segmentation.contracts.registry import CONTRACTS, recognise_contract

__all__ = ["CONTRACTS", "Encoding", "MaskLogits", "SamContract", "recognise_contract"]
