"""Trained network in eight bits: static quantisation with ONNX Runtime, one scale a channel."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import onnx
from onnxruntime.quantization import (
    CalibrationDataReader,
    CalibrationMethod,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process

from research.training.onnx_file import write_metadata

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray


class _Reader(CalibrationDataReader):  # type: ignore[misc]  # onnxruntime has no types
    def __init__(self, name: str, batches: Sequence[NDArray[Any]]) -> None:
        self._feeds = ({name: batch} for batch in batches)

    def get_next(self) -> dict[str, NDArray[Any]] | None:
        return next(self._feeds, None)


def write_eight_bits(
    model: Path,
    out: Path,
    batches: Sequence[NDArray[Any]],
    nodes: Callable[[onnx.ModelProto], Sequence[str]],
    metadata: Mapping[str, str],
) -> None:
    """Write a network with activations of eight bits and weights of seven.

    Sums of two products then fit 16 bits, in which x86 processors without dot products of bytes add
    them.

    Args:
        model: the float32 file, of one input.
        out: the file to write; it keeps the metadata.
        batches: inputs, all of one shape, to take the activations' ranges from.
        nodes: names of the nodes of a graph that get eight bits.
        metadata: what it says in the place of or beside the float32 file's.
    """
    with tempfile.TemporaryDirectory() as folder:
        prepared = Path(folder) / "prepared.onnx"
        quant_pre_process(str(model), str(prepared), skip_symbolic_shape=True)
        graph = onnx.load(prepared)
        quantize_static(
            str(prepared),
            str(out),
            _Reader(graph.graph.input[0].name, batches),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_quantize=list(nodes(graph)),
            calibrate_method=CalibrationMethod.MinMax,
        )
    write_metadata(
        out, {**{entry.key: entry.value for entry in onnx.load(model).metadata_props}, **metadata}
    )
