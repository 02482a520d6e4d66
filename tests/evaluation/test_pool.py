from __future__ import annotations

import threading
from contextlib import closing

from vehanchor_evaluation.pool import finished


def test_items_are_taken_up_as_the_pool_gets_through_them_and_left_when_it_is_closed() -> None:
    begun: list[int] = []
    lock = threading.Lock()

    def work(n: int) -> int:
        with lock:
            begun.append(n)
        return n

    with closing(finished(2, work, range(10**9))) as results:
        next(results)
    assert len(begun) < 50
