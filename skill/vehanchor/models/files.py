"""Files of an ONNX model: the graph, and the external weights of large exports.

``file_cached`` keeps what was loaded from them while they are unchanged.
"""

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
# Number of protobuf below 16,384: seven bits per byte, lowest first.
_LENGTH = rb"[\x80-\xff]?[\x00-\x7f]"
_LOCATION = re.compile(rb"\x6a" + _LENGTH + rb"\x0a\x08location\x12(" + _LENGTH + rb")")
"""Start of an entry of ``TensorProto.external_data`` (onnx.proto, field 13), key ``location``."""


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
    locations = external_locations(content)
    weights = tuple(path.parent / location for location in locations)
    for file in weights:
        if not file.is_file():
            raise ModelNotFoundError(
                f"the model {path} keeps weights in {file}, which is missing: copy it there, too"
            )
    return ModelFile(path, content, weights)


def models_sha256(*models: ModelFile) -> str:
    """Compute the SHA-256 of models in order, each followed by its external weights.

    Returns:
        The checksum in hexadecimal digits.
    """
    digest = hashlib.sha256()
    for model in models:
        digest.update(model.content)
        for file in model.weights:
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK_BYTES):
                    digest.update(block)
    return digest.hexdigest()


def external_locations(content: bytes) -> tuple[str, ...]:
    """List the files of a graph's external weights, relative to its folder, each once.

    The graph itself names the file of every tensor that is stored outside it. The entries are found
    by their bytes, wherever the tensor lies in the graph, because the ``onnx`` package is not a
    dependency. Files that are not a graph have none.
    """
    locations: dict[str, None] = {}
    for entry in _LOCATION.finditer(content):
        # Seven bits per byte, lowest first.
        length = 0
        for place, byte in enumerate(entry[1]):
            length += (byte & 0x7F) << 7 * place
        start = entry.end()
        name = content[start : start + length]
        locations[name.decode("utf-8", "replace")] = None
    return tuple(locations)


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
        A decorator for a function whose arguments that are ``os.PathLike`` are a model's files; it
        gets their absolute paths. All its arguments must be hashable. Exceptions are not cached.
    """

    def decorate(load: Callable[P, T]) -> Callable[P, T]:
        @functools.lru_cache(max_models)
        def loaded(
            states: tuple[_FileState, ...],  # part of the key: a changed file is another one
            args: tuple[Any, ...],
            named: tuple[tuple[str, Any], ...],
        ) -> T:
            del states
            return load(*args, **dict(named))

        @functools.wraps(load)
        def cached(*args: P.args, **kwargs: P.kwargs) -> T:
            positional = tuple(_absolute(value) for value in args)
            named = {name: _absolute(value) for name, value in kwargs.items()}
            states: list[_FileState] = []
            for value in (*positional, *named.values()):
                if isinstance(value, Path):
                    states += _states(value)
            return loaded(tuple(states), positional, tuple(named.items()))

        return cached

    return decorate


def _absolute(value: Any) -> Any:
    """Make a path absolute; return any other value as it is.

    Links are not resolved: external weights lie beside the given name, not beside the link's
    target.
    """
    if not isinstance(value, os.PathLike):
        return value
    return Path(value).absolute()


def _states(file: Path) -> list[_FileState]:
    """List the states of a model's file and of its external weights, without missing files."""
    state = _state(file)
    if state is None:
        return []
    states = [state]
    for location in _locations(state):
        weight_state = _state(file.parent / location)
        if weight_state is not None:
            states.append(weight_state)
    return states


def _state(file: Path) -> _FileState | None:
    """Read the state of a file; None for a missing one."""
    try:
        status = file.stat()
    # A NUL in the name is a ValueError.
    except (OSError, ValueError):
        return None
    return file, status.st_size, status.st_mtime_ns, status.st_ino


@functools.lru_cache(maxsize=32)
def _locations(state: _FileState) -> tuple[str, ...]:
    """List the files of a graph's external weights while the graph is unchanged."""
    path = state[0]
    try:
        return external_locations(path.read_bytes())
    # The path is a folder, for example; loading reports it.
    except OSError:
        return ()
