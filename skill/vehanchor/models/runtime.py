"""Runtime of models: execution providers, threads, progress and cancellation.

This module does not import ONNX Runtime, so that ``import vehanchor`` stays fast.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Self, TypeAlias

from vehanchor.errors import InvalidParameterError
from vehanchor.options.option import Limits, set_frozen

if TYPE_CHECKING:
    from collections.abc import Mapping

    import onnxruntime

DEFAULT_PROVIDERS = ("CPUExecutionProvider",)

MAX_THREADS = 256
"""Largest accepted number of threads: each needs a stack, and no model here needs more cores."""

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (done, total)."""


class Cancellation:
    """Ends the running models of a call from another thread; one object serves one call."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requested = False
        self._options: onnxruntime.RunOptions | None = None

    @property
    def requested(self) -> bool:
        """Whether ``cancel`` was called."""
        return self._requested

    def cancel(self) -> None:
        """End the running model after its current layer, and prevent further runs."""
        with self._lock:
            self._requested = True
            if self._options is not None:
                self._options.terminate = True

    @property
    def run_options(self) -> onnxruntime.RunOptions:
        """Run options that ONNX Runtime checks between layers."""
        from onnxruntime import RunOptions

        with self._lock:
            if self._options is None:
                self._options = RunOptions()
                self._options.terminate = self._requested
            return self._options


@dataclass(frozen=True)
class Runtime:
    """Settings for opening models (the first two fields) and for one call (the last two).

    Two runtimes are equal if they open models in the same way.

    Attributes:
        threads: CPU threads of each model; None leaves the number to ONNX Runtime.
        providers: execution providers in order of preference, by full name or as ``"cuda"``,
            ``"cpu"``. If ``cpu`` is among them, a missing provider is skipped with a warning in the
            log. A single name is accepted, too.
        progress: called with (done, total): tiles of an image, photographs of a flight. An
            exception that it raises ends the call.
        cancellation: ends the call from another thread.

    Raises:
        InvalidParameterError: ``threads`` or ``providers`` is invalid.
    """

    threads: int | None = None
    providers: Sequence[str] = DEFAULT_PROVIDERS
    progress: Progress | None = field(default=None, compare=False)
    cancellation: Cancellation | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        set_frozen(self, "threads", _checked_threads(self.threads))
        set_frozen(self, "providers", _checked_providers(self.providers))

    @property
    def idle(self) -> Runtime:
        """Runtime without progress and cancellation, with which models are opened and cached."""
        if self.progress is None and self.cancellation is None:
            return self
        return self.during(Runtime())

    def during(self, call: Runtime) -> Runtime:
        """Copy the runtime with the progress and the cancellation of a call."""
        return replace(self, progress=call.progress, cancellation=call.cancellation)

    def with_keywords(self, keywords: Mapping[str, Any]) -> Runtime:
        """Copy the runtime with other fields; None leaves a field as it is."""
        changes = {name: value for name, value in keywords.items() if value is not None}
        if not changes:
            return self
        return replace(self, **changes)

    def report_progress(self, done: int, total: int) -> None:
        """Report progress, if anybody follows it."""
        if self.progress is not None:
            self.progress(done, total)


def _checked_threads(threads: Any) -> int | None:
    """Check a number of threads.

    Raises:
        InvalidParameterError: it is not a whole number in the limits.
    """
    if threads is None:
        return None
    try:
        return int(Limits(1, MAX_THREADS, whole=True).check("threads", threads))
    except InvalidParameterError as error:
        raise InvalidParameterError(f"{error}, or None for all cores") from None


def _checked_providers(providers: Any) -> tuple[str, ...]:
    """Check the names of execution providers; None gives the default.

    Raises:
        InvalidParameterError: there is none, or one is not a string.
    """
    if providers is None:
        return DEFAULT_PROVIDERS
    if isinstance(providers, str):
        providers = [providers]
    names = tuple(providers)
    if not names or not all(isinstance(name, str) for name in names):
        raise InvalidParameterError(f"providers is {providers!r}: name them, as in ['cuda', 'cpu']")
    return names


class LoadedModel:
    """Base of models that are opened once and run by many calls.

    Attributes:
        runtime: how the model was opened, and the call that it runs for.
    """

    runtime: Runtime = Runtime()

    def under(self, call: Runtime) -> Self:
        """Bind the model to the progress and the cancellation of one call."""
        runtime = self.runtime
        if call.progress is runtime.progress and call.cancellation is runtime.cancellation:
            return self
        bound = copy.copy(self)
        bound.runtime = self.runtime.during(call)
        return bound
