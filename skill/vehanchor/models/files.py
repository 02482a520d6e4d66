"""An ONNX model as files: the graph, and the files beside it in which large exports keep their weights.

Where the weights are is written in the graph itself, in every tensor that is not stored in it (``onnx.proto``:
``TensorProto.external_data``). Only those fields are read here: the ``onnx`` package is none of our dependencies.
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
    """A model's file as it was read once, so that what is hashed is what is run.

    Attributes:
        path: of the file.
        content: its bytes.
        weights: files beside it that keep its weights, in the order in which the graph names them; none as a rule.
    """

    path: Path
    content: bytes
    weights: tuple[Path, ...]


def check_model_file(path: Path) -> None:
    """Make sure that there is a file to open.

    Raises:
        ModelNotFoundError: there is none.
    """
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model file at {path}; pass the path of an ONNX file, or see 'vehanchor models list'"
        )


def read_model(path: Path) -> ModelFile:
    """Read a model's file and find the files of its weights.

    Raises:
        ModelNotFoundError: there is no such file, or one of its weights is missing.
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
    """SHA-256, as hexadecimal digits, of models one after the other, each followed by its files of weights."""
    digest = hashlib.sha256()
    for model in models:
        digest.update(model.content)
        for file in model.weights:
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
    return digest.hexdigest()


def external_locations(content: bytes) -> tuple[str, ...]:
    """The files that a graph keeps weights in, relative to its own folder, each once; none for what is no ONNX file."""
    if b"location" not in content:  # the key of every such entry; spares nearly all models the walk
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
    """Numbers and bodies of a message's strings and sub-messages, up to its end or to where it is no protobuf."""
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
    except IndexError:  # cut off: whoever opens it will say so
        return


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """A number of seven bits a byte, the lowest first, and where it ends."""
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
