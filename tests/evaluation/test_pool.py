from __future__ import annotations

import threading
from contextlib import closing

from vehanchor_evaluation.pool import finished


def test_a_closed_pool_drops_items_that_have_not_started() -> None:
    started: list[int] = []
    lock = threading.Lock()

    def work(n: int) -> int:
        with lock:
            started.append(n)
        return n

    with closing(finished(2, work, range(10**9))) as results:
        next(results)
    assert len(started) < 50
