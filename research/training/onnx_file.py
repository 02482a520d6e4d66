"""Networks as ONNX files: one opset, one licence, metadata of our own, whole files or none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import onnx
import torch

from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from torch import Tensor, nn

LICENCE = "Apache-2.0"
_OPSET = 17


def write_onnx(
    network: nn.Module,
    examples: tuple[Tensor, ...],
    out: Path,
    inputs: Sequence[str],
    outputs: Sequence[str],
    free: Mapping[str, Mapping[int, str]] | None = None,
) -> None:
    """Write a network in evaluation mode.

    Args:
        network: what is called with the examples.
        examples: one for each input; their shapes are the file's but for what is free.
        out: the file.
        inputs: their names.
        outputs: names of what it returns.
        free: names of the axes of inputs and outputs that may have any length.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as partial:
        torch.onnx.export(
            network.eval(),
            examples,
            str(partial),
            input_names=list(inputs),
            output_names=list(outputs),
            dynamic_axes={name: dict(axes) for name, axes in (free or {}).items()},
            opset_version=_OPSET,
            dynamo=False,
        )


def write_metadata(path: Path, metadata: Mapping[str, str]) -> None:
    """Replace the custom metadata of an ONNX file."""
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, dict(metadata))
    model.producer_name = "vehanchor"
    model.producer_version = ""
    model.doc_string = ""
    with whole_file(path) as partial:
        onnx.save(model, partial)
