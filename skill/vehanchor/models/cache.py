"""Cache of loaded models, valid while their files are unchanged."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

from vehanchor.models.files import external_locations

if TYPE_CHECKING:
    from collections.abc import Callable

P = ParamSpec("P")
T = TypeVar("T")


class _FileState(NamedTuple):
    """Properties by which a changed file is detected."""

    path: Path
    size_bytes: int
    mtime_ns: int
    inode: int


def file_cached(max_models: int) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Cache what a function loads from model files, until one of the files changes.

    Files, including those with external weights, are identified by absolute path, size, time and inode. A replaced
    model is therefore loaded again, and a relative path after ``chdir`` is another file.

    Args:
        max_models: maximum number of cached results; the least recently used is dropped first.

    Returns:
        A decorator for a function whose arguments that are ``os.PathLike`` are ONNX files; it gets their absolute
        paths. All its arguments must be hashable. Exceptions are not cached.
    """

    def decorate(load: Callable[P, T]) -> Callable[P, T]:
        @functools.lru_cache(max_models)
        def loaded(states: tuple[_FileState, ...], args: tuple[Any, ...], named: tuple[tuple[str, Any], ...]) -> T:
            del states
            return load(*args, **dict(named))

        @functools.wraps(load)
        def cached(*args: P.args, **kwargs: P.kwargs) -> T:
            given, named = [_absolute(each) for each in args], {name: _absolute(each) for name, each in kwargs.items()}
            files = [each for each in (*given, *named.values()) if isinstance(each, Path)]
            states = tuple(state for file in files for state in _states(file))
            return loaded(states, tuple(given), tuple(named.items()))

        return cached

    return decorate


def _absolute(value: Any) -> Any:
    # Links are not resolved: external weights lie beside the given name, not beside the link's target.
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
    return _FileState(file, found.st_size, found.st_mtime_ns, found.st_ino)


@functools.lru_cache(maxsize=32)
def _locations(state: _FileState) -> tuple[str, ...]:
    try:
        return external_locations(state.path.read_bytes())
    except OSError:  # for example a folder; loading reports it
        return ()
