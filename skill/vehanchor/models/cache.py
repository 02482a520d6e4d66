"""Cache of loaded models, valid while their files are unchanged."""

from __future__ import annotations

import functools
import os
import threading
from collections import OrderedDict
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
        A decorator for a function whose positional arguments, and whose keyword arguments that are ``os.PathLike``, are
        ONNX files. All its other arguments must be hashable. Exceptions are not cached.
    """

    def decorate(load: Callable[P, T]) -> Callable[P, T]:
        kept: OrderedDict[Any, tuple[tuple[_FileState, ...], T]] = OrderedDict()
        lock = threading.Lock()

        @functools.wraps(load)
        def cached(*args: P.args, **kwargs: P.kwargs) -> T:
            named = {name: value for name, value in kwargs.items() if isinstance(value, os.PathLike)}
            # Links are not resolved: external weights lie beside the given name, not beside the link's target.
            files = tuple(Path(str(file)).absolute() for file in (*args, *named.values()))
            key = files, tuple(named), frozenset((name, kwargs[name]) for name in kwargs if name not in named)
            states = tuple(state for file in files for state in _states(file))
            with lock:
                if key in kept and kept[key][0] == states:
                    kept.move_to_end(key)
                    return kept[key][1]
            loaded = load(*args, **kwargs)  # without the lock: one slow model must not hold up the others
            with lock:
                kept[key] = states, loaded
                kept.move_to_end(key)
                while len(kept) > max_models:
                    kept.popitem(last=False)
            return loaded

        return cached

    return decorate


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
