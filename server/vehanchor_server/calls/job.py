"""One call's work in its thread: it ends when asked to, tells how far it is, and marks its stages for OpenTelemetry."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from opentelemetry import trace

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    import onnxruntime

    from vehanchor_server.calls.capacity import Stop

PERCENT_READ, PERCENT_SEARCHED, PERCENT_DONE = 10, 95, 100
_tracer = trace.get_tracer("vehanchor_server")


class Stages:
    """The stages of a call as spans; a context manager that ends the last one."""

    def __init__(self) -> None:
        self._span: trace.Span | None = None

    def __enter__(self) -> Stages:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._span is not None and isinstance(error, Exception):
            self._span.set_status(trace.StatusCode.ERROR, type(error).__name__)
        self._end()

    def enter(self, stage: str) -> None:
        """Begin a stage, and end the one before."""
        self._end()
        self._span = _tracer.start_span(f"vehanchor.{stage}")

    def _end(self) -> None:
        if self._span is not None:
            self._span.end()
            self._span = None


class Job:
    """One call's work as it reports on itself.

    Args:
        stop: asks the work to end.
        report: gets percent and words.
        entered: gets the name of each stage as it begins.
    """

    def __init__(self, stop: Stop, report: Callable[[float, str], None], entered: Callable[[str], None]) -> None:
        self.stop = stop
        self._report = report
        self._entered = entered
        self._reported = -1

    @cached_property
    def run_options(self) -> onnxruntime.RunOptions:
        """For every run of a model: a stop request ends the run within a layer."""
        from vehanchor.models.session import stoppable  # ONNX Runtime is slow to load: not before a call needs it

        options = stoppable()
        self.stop.on_request(lambda: setattr(options, "terminate", True))
        return options

    def enter(self, stage: str) -> None:
        """Begin a stage (``decode``, ``segment``, ``detect``, ``scale``, ...), and end the one before.

        Raises:
            CallStoppedError: the call was asked to end.
        """
        self.stop.check()
        self._entered(stage)

    def segmenting(self) -> None:
        """Begin the search for the object's mask; its report takes the place of the first one of ``searched``.

        Raises:
            CallStoppedError: the call was asked to end.
        """
        self.enter("segment")
        self._reported = 0
        self._report(PERCENT_READ, "looking for the object")

    def searched(self, done: int, total: int) -> None:
        """Report tiles as progress: at the start, the middle and the end, whatever their number.

        Raises:
            CallStoppedError: the call was asked to end.
        """
        self.stop.check()
        if done == 0:
            self.enter("detect")
        half = 2 * done // total
        if half > self._reported:
            self._reported = half
            percent = PERCENT_READ + (PERCENT_SEARCHED - PERCENT_READ) * done / total
            self._report(percent, f"searched {done} of {total} tiles")
        if done == total:
            self.enter("scale")
