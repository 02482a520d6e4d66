from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest

from vehanchor.batch.pool import finished, finished_in_threads


def test_every_item_comes_back_with_its_result_or_its_error() -> None:
    with closing(finished_in_threads(3, lambda n: 10 // n, range(-5, 6))) as results:
        found = dict(results)
    assert {n: future.result() for n, future in found.items() if n} == {n: 10 // n for n in range(-5, 6) if n}
    with pytest.raises(ZeroDivisionError):
        found[0].result()


def test_items_are_taken_up_as_the_pool_gets_through_them_and_left_when_it_is_closed() -> None:
    begun: list[int] = []
    lock = threading.Lock()

    def work(n: int) -> int:
        with lock:
            begun.append(n)
        return n

    pool = ThreadPoolExecutor(2)
    with closing(finished(pool, 2, work, range(10**9))) as results:
        next(results)
    assert len(begun) < 50
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.submit(work, 1)
