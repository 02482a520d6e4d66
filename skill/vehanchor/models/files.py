"""Files of an ONNX model: the graph, and the external weights of large exports; a cache while they are unchanged."""

from __future__ import annotations

import functools
import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar

from vehanchor.errors import ModelContractError, ModelNotFoundError

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
T = TypeVar("T")

_BLOCK_BYTES = 1 << 20
# protobuf's number below 16,384: seven bits per byte, lowest first
_LENGTH = rb"[\x80-\xff]?[\x00-\x7f]"
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
            f"no model file at {path}; pass the path of an ONNX file, or see 'vehanchor models "
            "list'"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelContractError(
            f"the model file {path} cannot be read: {error.strerror}"
        ) from error
    weights = tuple(path.parent / location for location in external_locations(content))
    for file in weights:
        if not file.is_file():
            raise ModelNotFoundError(
                f"the model {path} keeps weights in {file}, which is missing: copy it there, too"
            )
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

    The graph itself names the file of every tensor that is stored outside it. The entries are found
    by their bytes, wherever the tensor lies in the graph, because the ``onnx`` package is not a
    dependency.
    """
    found: dict[str, None] = {}
    for entry in _LOCATION.finditer(content):
        length = sum((byte & 0x7F) << 7 * place for place, byte in enumerate(entry[1]))
        found[content[entry.end() : entry.end() + length].decode("utf-8", "replace")] = None
    return tuple(found)


_FileState: TypeAlias = tuple[Path, int, int, int]
"""Path, size in bytes, time and inode, by which a changed file is detected."""


def file_cached(max_models: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache what a function loads from model files, until one of the files changes.

    Files, including those with external weights, are identified by absolute path, size, time and
    inode. A replaced model is therefore loaded again, and a relative path after ``chdir`` is
    another file.

    Args:
        max_models: maximum number of cached results; the least recently used is dropped first.

    Returns:
        A decorator for a function whose arguments that are ``os.PathLike`` are ONNX files; it gets
        their absolute paths. All its arguments must be hashable. Exceptions are not cached.
    """

    def decorate(load: Callable[P, T]) -> Callable[P, T]:
        @functools.lru_cache(max_models)
        def loaded(
            states: tuple[_FileState, ...],
            args: tuple[Any, ...],
            named: tuple[tuple[str, Any], ...],
        ) -> T:
            del states
            return load(*args, **dict(named))

        @functools.wraps(load)
        def cached(*args: P.args, **kwargs: P.kwargs) -> T:
            given = [_absolute(each) for each in args]
            named = {name: _absolute(each) for name, each in kwargs.items()}
            files = [each for each in (*given, *named.values()) if isinstance(each, Path)]
            states = tuple(state for file in files for state in _states(file))
            return loaded(states, tuple(given), tuple(named.items()))

        return cached

    return decorate


def _absolute(value: Any) -> Any:
    # Links are not resolved: external weights lie beside the given name, not beside the link's
    # target.
    return Path(value).absolute() if isinstance(value, os.PathLike) else value


def _states(file: Path) -> list[_FileState]:
    """List the states of a model's file and of its external weights, without missing files."""
    state = _state(file)
    if state is None:
        return []
    beside = (_state(file.parent / location) for location in _locations(state))
    return [state, *(weights for weights in beside if weights is not None)]


def _state(file: Path) -> _FileState | None:
    try:
        found = file.stat()
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return None
    return file, found.st_size, found.st_mtime_ns, found.st_ino


@functools.lru_cache(maxsize=32)
def _locations(state: _FileState) -> tuple[str, ...]:
    try:
        return external_locations(state[0].read_bytes())
    except OSError:  # for example a folder; loading reports it
        return ()
