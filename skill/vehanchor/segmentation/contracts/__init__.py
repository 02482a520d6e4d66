"""Contracts of promptable segmenters in ONNX files, recognised by the names of their inputs and outputs.

To add one, write a file with one class and add the class to ``CONTRACTS``.

Coordinates: a crop's first pixel spans 0 to 1. All these graphs take pixel indices, as SAM does,
and add half a pixel of the model's input. Each contract therefore subtracts that half.

Choice of the mask: a box, or two and more points, is unambiguous. A decoder with a single-mask
output (the first of four masks) then gives that one, as SAM's own predictor does. One point may
mean a part or the whole. Then, and for decoders with three masks, the mask with the highest score
is chosen. SAM's padding point is always added, so that decoders exported with
``--return-single-mask`` choose by the same rule.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import ModelContractError
from vehanchor.segmentation.contracts.base import DTYPES, MaskLogits, SamContract
from vehanchor.segmentation.contracts.efficient_sam import EfficientSam
from vehanchor.segmentation.contracts.sam import Sam
from vehanchor.segmentation.contracts.sam2 import Sam2
from vehanchor.segmentation.contracts.transformers import Transformers

if TYPE_CHECKING:
    from vehanchor.models.session import Session

__all__ = ["CONTRACTS", "MaskLogits", "SamContract", "recognise_contract"]

CONTRACTS: tuple[type[SamContract], ...] = (Sam, Sam2, Transformers, EfficientSam)
"""All contracts."""

_OPTIONAL_INPUTS = frozenset({"mask_input", "has_mask_input", "orig_im_size"})  # of decoders


def recognise_contract(
    encoder: Session, decoder: Session, input_px: int | None = None
) -> SamContract:
    """Recognise the contract of an encoder and a decoder by the names of their inputs and outputs.

    Args:
        encoder: session of the image encoder.
        decoder: session of the mask decoder.
        input_px: side of the model's input from its metadata; None if they have none.

    Returns:
        The contract, ready to run.

    Raises:
        ModelContractError: no contract fits the names, or the shapes are not supported.
    """
    listed = (encoder.get_inputs, encoder.get_outputs, decoder.get_inputs, decoder.get_outputs)
    found = [frozenset(item.name for item in items()) for items in listed]
    for kind in CONTRACTS:
        wanted = (
            kind.encoder_inputs,
            kind.encoder_outputs,
            kind.decoder_inputs,
            frozenset(kind.decoder_outputs),
        )
        # Further inputs of the decoder must be among the optional ones.
        if found[0] == wanted[0] and all(
            names <= have for names, have in zip(wanted[1:], found[1:], strict=True)
        ):
            extra = found[2] - wanted[2] - _OPTIONAL_INPUTS
            types = {item.type for session in (encoder, decoder) for item in session.get_inputs()}
            if not extra and types <= DTYPES.keys():
                return kind(encoder, decoder, input_px)
    swapped = (
        " (are encoder and decoder swapped?)"
        if found[2] in [kind.encoder_inputs for kind in CONTRACTS]
        else ""
    )
    shown = "; ".join(
        f"{what} {', '.join(sorted(names)) or 'nothing'}"
        for what, names in zip(
            ("encoder in:", "encoder out:", "decoder in:", "decoder out:"), found, strict=True
        )
    )
    *kinds, last = (kind.described for kind in CONTRACTS)
    raise ModelContractError(
        f"not a promptable segmenter of a known kind{swapped}: {shown}. Expected "
        f"{', '.join(kinds)}, or {last}"
    )
