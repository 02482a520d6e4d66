"""Files of an ONNX model: the graph, and the external weights of large exports.

The graph itself names the file of every tensor that is stored outside it (``onnx.proto``:
``TensorProto.external_data``). This module reads only those fields, because the ``onnx`` package is not a dependency.
"""

from __future__ import annotations

import hashlib
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor.errors import ModelContractError, ModelNotFoundError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_BLOCK_BYTES = 1 << 20
_VARINT, _EIGHT_BYTES, _COUNTED, _FOUR_BYTES = 0, 1, 2, 5  # protobuf wire types
_MODEL, _GRAPH, _NODE, _ATTRIBUTE, _SPARSE, _FUNCTION, _TENSOR = range(7)
# Message -> its fields that lead to tensors, by number (onnx.proto, stable since IR version 3).
_CHILDREN: dict[int, dict[int, int]] = {
    _MODEL: {7: _GRAPH, 25: _FUNCTION},
    _GRAPH: {1: _NODE, 5: _TENSOR, 15: _SPARSE},
    _NODE: {5: _ATTRIBUTE},
    _ATTRIBUTE: {5: _TENSOR, 6: _GRAPH, 10: _TENSOR, 11: _GRAPH, 22: _SPARSE, 23: _SPARSE},
    _SPARSE: {1: _TENSOR, 2: _TENSOR},
    _FUNCTION: {7: _NODE, 11: _ATTRIBUTE},
    _TENSOR: {},
}
_EXTERNAL_DATA, _ENTRY_KEY, _ENTRY_VALUE = 13, 1, 2


@dataclass(frozen=True, eq=False)
class ModelFile:
    """Model file that is read once, so that the hashed bytes are the ones that run.

    Attributes:
        path: path of the file.
        content: bytes of the file.
        weights: files of external weights, in the order of the graph; most models have none.
    """

    path: Path
    content: bytes
    weights: tuple[Path, ...]


def check_model_file(path: Path) -> None:
    """Check that a model file exists.

    Raises:
        ModelNotFoundError: there is no such file.
    """
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model file at {path}; pass the path of an ONNX file, or see 'vehanchor models list'"
        )


def read_model(path: Path) -> ModelFile:
    """Read a model's file and find its external weights.

    Raises:
        ModelNotFoundError: the file, or one of its external weights, is missing.
        ModelContractError: the file cannot be read.
    """
    check_model_file(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelContractError(f"the model file {path} cannot be read: {error.strerror}") from error
    weights = tuple(path.parent / location for location in external_locations(content))
    for file in weights:
        if not file.is_file():
            raise ModelNotFoundError(f"the model {path} keeps weights in {file}, which is missing: copy it there, too")
    return ModelFile(path, content, weights)


def models_sha256(*models: ModelFile) -> str:
    """Compute the SHA-256, in hexadecimal digits, of models in order, each followed by its external weights."""
    digest = hashlib.sha256()
    for model in models:
        digest.update(model.content)
        for file in model.weights:
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
    return digest.hexdigest()


def external_locations(content: bytes) -> tuple[str, ...]:
    """List the files of a graph's external weights, relative to its folder, each once; empty for other files."""
    if b"location" not in content:  # key of every such entry; most models have none and need no walk
        return ()
    found: dict[str, None] = {}
    queue = deque([(_MODEL, memoryview(content))])
    while queue:
        kind, message = queue.popleft()
        for number, body in _counted_fields(message):
            if number in _CHILDREN[kind]:
                queue.append((_CHILDREN[kind][number], body))
            elif kind == _TENSOR and number == _EXTERNAL_DATA:
                entry = {key: bytes(text).decode("utf-8", "replace") for key, text in _counted_fields(body)}
                if entry.get(_ENTRY_KEY) == "location":
                    found[entry.get(_ENTRY_VALUE, "")] = None
    return tuple(found)


def _counted_fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield numbers and bodies of a message's strings and sub-messages, up to its end or the first invalid field."""
    position = 0
    try:
        while position < len(message):
            tag, position = _varint(message, position)
            wire = tag & 7
            if wire == _VARINT:
                _, position = _varint(message, position)
            elif wire == _COUNTED:
                length, position = _varint(message, position)
                yield tag >> 3, message[position : position + length]
                position += length
            elif wire in (_EIGHT_BYTES, _FOUR_BYTES):
                position += 8 if wire == _EIGHT_BYTES else 4
            else:
                return
    except IndexError:  # truncated; opening the model reports it
        return


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Read a number of seven bits per byte, lowest first; return it with the position after it."""
    value = shift = 0
    while True:
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
        if shift > 63:
            raise IndexError("longer than any number of 64 bits")
