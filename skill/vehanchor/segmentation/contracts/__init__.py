"""Contracts of promptable segmenters in ONNX files.

The names of inputs and outputs identify a contract. To add a contract, write a file with one class
and add the class to ``CONTRACTS``.

Coordinates: a crop's first pixel spans 0 to 1. All these graphs take pixel indices, as SAM does,
and add half a pixel of the model's input. Each contract therefore subtracts that half.

Choice of the mask: a box, or two and more points, is unambiguous. A decoder with a single-mask
output (the first of four masks) then provides the mask, as in SAM's own predictor. One point may
mean a part or the whole. Then, and for decoders with three masks, the mask with the highest score
is chosen. SAM's padding point is always added, so that decoders exported with
``--return-single-mask`` choose by the same rule.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.errors import ModelContractError
from vehanchor.segmentation.contracts.base import (
    DTYPES,
    EncodedCrop,
    MaskLogits,
    SamContract,
)
from vehanchor.segmentation.contracts.efficient_sam import EfficientSam
from vehanchor.segmentation.contracts.sam import Sam
from vehanchor.segmentation.contracts.sam2 import Sam2
from vehanchor.segmentation.contracts.transformers import Transformers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.models.session import Session

__all__ = ["CONTRACTS", "EncodedCrop", "MaskLogits", "SamContract", "recognise_contract"]

CONTRACTS: tuple[type[SamContract], ...] = (Sam, Sam2, Transformers, EfficientSam)
"""All contracts."""

# A decoder may have these inputs besides those of its contract.
_OPTIONAL_INPUTS = frozenset({"mask_input", "has_mask_input", "orig_im_size"})


class _GraphNames(NamedTuple):
    """Names of the inputs and outputs of an encoder and a decoder."""

    encoder_inputs: frozenset[str]
    encoder_outputs: frozenset[str]
    decoder_inputs: frozenset[str]
    decoder_outputs: frozenset[str]

    def __str__(self) -> str:
        return (
            f"encoder in: {_listed(self.encoder_inputs)}; "
            f"encoder out: {_listed(self.encoder_outputs)}; "
            f"decoder in: {_listed(self.decoder_inputs)}; "
            f"decoder out: {_listed(self.decoder_outputs)}"
        )

    def fit(self, contract: type[SamContract]) -> bool:
        """Test whether the graphs have all names of a contract, and no unknown inputs."""
        if self.encoder_inputs != contract.encoder_inputs:
            return False
        if not contract.encoder_outputs <= self.encoder_outputs:
            return False
        if not contract.decoder_inputs <= self.decoder_inputs:
            return False
        if not self.decoder_outputs.issuperset(contract.decoder_outputs):
            return False
        further_inputs = self.decoder_inputs - contract.decoder_inputs
        return further_inputs <= _OPTIONAL_INPUTS


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
    names = _GraphNames(
        encoder_inputs=_names(encoder.get_inputs()),
        encoder_outputs=_names(encoder.get_outputs()),
        decoder_inputs=_names(decoder.get_inputs()),
        decoder_outputs=_names(decoder.get_outputs()),
    )
    inputs = (*encoder.get_inputs(), *decoder.get_inputs())
    if all(item.type in DTYPES for item in inputs):
        for contract in CONTRACTS:
            if names.fit(contract):
                return contract(encoder, decoder, input_px)
    swapped = ""
    encoders = [contract.encoder_inputs for contract in CONTRACTS]
    if names.decoder_inputs in encoders:
        swapped = " (are encoder and decoder swapped?)"
    described = [contract.described for contract in CONTRACTS]
    *kinds, last = described
    raise ModelContractError(
        f"not a promptable segmenter of a known kind{swapped}: {names}. Expected "
        f"{', '.join(kinds)}, or {last}"
    )


def _listed(names: frozenset[str]) -> str:
    return ", ".join(sorted(names)) or "nothing"


def _names(items: Sequence[Any]) -> frozenset[str]:
    return frozenset(item.name for item in items)
