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
"""Largest accepted number of threads: each needs a stack, and no model here profits from more cores."""

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
        return (
            self if self.progress is None and self.cancellation is None else self.during(Runtime())
        )

    def during(self, call: Runtime) -> Runtime:
        """Copy the runtime with the progress and the cancellation of a call."""
        return replace(self, progress=call.progress, cancellation=call.cancellation)

    def with_keywords(self, keywords: Mapping[str, Any]) -> Runtime:
        """The same runtime with other fields; None leaves a field as it is."""
        changes = {name: value for name, value in keywords.items() if value is not None}
        return replace(self, **changes) if changes else self

    def tell(self, done: int, total: int) -> None:
        """Report progress, if anybody follows it."""
        if self.progress is not None:
            self.progress(done, total)


def _checked_threads(threads: Any) -> int | None:
    if threads is None:
        return None
    try:
        return int(Limits(1, MAX_THREADS, whole=True).check("threads", threads))
    except InvalidParameterError as error:
        raise InvalidParameterError(f"{error}, or None for all cores") from None


def _checked_providers(providers: Any) -> tuple[str, ...]:
    if providers is None:
        return DEFAULT_PROVIDERS
    named = (providers,) if isinstance(providers, str) else tuple(providers)
    if not named or not all(isinstance(name, str) for name in named):
        raise InvalidParameterError(f"providers is {providers!r}: name them, as in ['cuda', 'cpu']")
    return named


class LoadedModel:
    """Base of models that are opened once and run by many calls.

    Attributes:
        runtime: how the model was opened, and the call that it runs for.
    """

    runtime: Runtime = Runtime()

    def under(self, call: Runtime) -> Self:
        """Bind the model to one call: its runs report to the call's progress and obey its cancellation."""
        if (
            call.progress is self.runtime.progress
            and call.cancellation is self.runtime.cancellation
        ):
            return self
        bound = copy.copy(self)
        bound.runtime = self.runtime.during(call)
        return bound
