"""Count the time of the networks; the rest of a run is what the pipeline adds."""

from __future__ import annotations

from collections import defaultdict
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import onnxruntime

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@contextmanager
def networks_seconds(clock: Callable[[], float]) -> Iterator[dict[str, float]]:
    """Count the seconds in ONNX Runtime, by the names of the networks' inputs and outputs.

    Args:
        clock: ``time.perf_counter``; or ``time.thread_time`` for CPU time, which is all of a network's where it runs in
            one thread.

    Yields:
        Seconds, growing.
    """
    spent: dict[str, float] = defaultdict(float)
    run = onnxruntime.InferenceSession.run

    def timed(session: Any, outputs: Any, feeds: Any, run_options: Any = None) -> Any:
        started = clock()
        try:
            return run(session, outputs, feeds, run_options)
        finally:
            spent[f"{next(iter(feeds))} to {session.get_outputs()[0].name}"] += clock() - started

    onnxruntime.InferenceSession.run = timed
    try:
        yield spent
    finally:
        onnxruntime.InferenceSession.run = run
