"""Job: the stops, progress and OpenTelemetry stages of a call's work."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from opentelemetry import trace

from vehanchor.models.runtime import Cancellation, Runtime

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from vehanchor_server.calls.capacity import Stop

PERCENT_READ, PERCENT_SEARCHED, PERCENT_DONE = 10, 95, 100
_tracer = trace.get_tracer("vehanchor_server")


class Stages:
    """Stages of a call as spans: a context manager that ends the last one."""

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
        """Begin a stage and end the previous one."""
        self._end()
        self._span = _tracer.start_span(f"vehanchor.{stage}")

    def _end(self) -> None:
        if self._span is not None:
            self._span.end()
            self._span = None


class Job:
    """Control of a call's work.

    Args:
        stop: request to end the work.
        report: receives percentages and messages.
        entered: receives the name of each stage when it begins.
    """

    def __init__(self, stop: Stop, report: Callable[[float, str], None], entered: Callable[[str], None]) -> None:
        self.stop = stop
        self.cancellation = Cancellation()
        self._report = report
        self._entered = entered
        self._reported = -1

    @cached_property
    def runtime(self) -> Runtime:
        """Runtime for models: it reports tiles, and a stop request ends a run within a layer."""
        return Runtime(progress=self.searched, cancellation=self.cancellation)

    def enter(self, stage: str) -> None:
        """Begin a stage (``decode``, ``segment``, ``detect``, ``scale``, ...) and end the previous one.

        Raises:
            CallStoppedError: a stop was requested.
        """
        self.stop.check()
        self._entered(stage)

    def segmenting(self) -> None:
        """Begin the segmentation; its report replaces the first one of ``searched``.

        Raises:
            CallStoppedError: a stop was requested.
        """
        self.enter("segment")
        self._reported = 0
        self._report(PERCENT_READ, "segmenting the object")

    def searched(self, done: int, total: int) -> None:
        """Report searched tiles at the start, in the middle and at the end.

        Raises:
            CallStoppedError: a stop was requested.
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
