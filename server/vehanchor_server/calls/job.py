"""Job: the stops and the progress of a call's work."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Callable

    from vehanchor_server.calls.capacity import Stop

PERCENT_READ = 10
PERCENT_SEARCHED = 95
PERCENT_DONE = 100


class Job:
    """Control of a call's work.

    Args:
        stop: request to end the work.
        report: receives percentages and messages.
    """

    def __init__(self, stop: Stop, report: Callable[[float, str], None]) -> None:
        self.stop = stop
        self._report = report
        self._reported_halves = -1  # of the search: none yet

    @cached_property
    def runtime(self) -> Runtime:
        """Runtime for models: it reports tiles, and a stop request ends a run within a layer."""
        return Runtime(progress=self.searched, cancellation=self.stop)

    def segmenting(self) -> None:
        """Begin the segmentation; its report replaces the first one of ``searched``.

        Raises:
            CallStoppedError: a stop was requested.
        """
        self.stop.check()
        self._reported_halves = 0
        self._report(PERCENT_READ, "segmenting the object")

    def searched(self, done: int, total: int) -> None:
        """Report searched tiles at the start, in the middle and at the end.

        Args:
            done: number of searched tiles.
            total: number of tiles.

        Raises:
            CallStoppedError: a stop was requested.
        """
        self.stop.check()
        n_halves = 2 * done // total
        if n_halves > self._reported_halves:
            self._reported_halves = n_halves
            percent = PERCENT_READ + (PERCENT_SEARCHED - PERCENT_READ) * done / total
            self._report(percent, f"searched {done} of {total} tiles")
