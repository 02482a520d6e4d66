"""Work on a pool of threads, with results in order of completion."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

# Keeps all workers busy; a million futures would fill the memory.
_QUEUED_PER_WORKER = 2
Item = TypeVar("Item")
Result = TypeVar("Result")


def finished(
    workers: int, work: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[tuple[Item, Future[Result]]]:
    """Process all items in threads, which can share a model.

    Closing the generator shuts the pool down and drops items that have not started: use it in
    ``closing``.

    Args:
        workers: number of threads.
        work: function for one item.
        items: consumed as threads become free.

    Yields:
        Each item with its finished future, in order of completion.
    """
    waiting = iter(items)
    pool = ThreadPoolExecutor(workers)

    def submit_next(n: int) -> dict[Future[Result], Item]:
        return {pool.submit(work, item): item for item in islice(waiting, n)}

    try:
        running = submit_next(workers * _QUEUED_PER_WORKER)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            ready = [(running.pop(future), future) for future in done]
            running |= submit_next(len(ready))
            yield from ready
    finally:
        pool.shutdown(cancel_futures=True)
