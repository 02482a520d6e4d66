"""Files of an ONNX model: the graph, and the external weights of large exports."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor.errors import ModelContractError, ModelNotFoundError

if TYPE_CHECKING:
    from pathlib import Path

_BLOCK_BYTES = 1 << 20
_LENGTH = rb"[\x80-\xff]?[\x00-\x7f]"  # protobuf's number below 16,384: seven bits per byte, lowest first
_LOCATION = re.compile(rb"\x6a" + _LENGTH + rb"\x0a\x08location\x12(" + _LENGTH + rb")")
"""Start of an entry of ``TensorProto.external_data`` (onnx.proto, field 13) with the key ``location``."""


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


def read_model(path: Path) -> ModelFile:
    """Read a model's file and find its external weights.

    Raises:
        ModelNotFoundError: the file, or one of its external weights, is missing.
        ModelContractError: the file cannot be read.
    """
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model file at {path}; pass the path of an ONNX file, or see 'vehanchor models list'"
        )
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
    """List the files of a graph's external weights, relative to its folder, each once; empty for other files.

    The graph itself names the file of every tensor that is stored outside it. The entries are found by their bytes,
    wherever the tensor lies in the graph, because the ``onnx`` package is not a dependency.
    """
    found: dict[str, None] = {}
    for entry in _LOCATION.finditer(content):
        length = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(entry[1]))
        found[content[entry.end() : entry.end() + length].decode("utf-8", "replace")] = None
    return tuple(found)
