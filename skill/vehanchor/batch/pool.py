"""Many pieces of work on a pool of threads or processes, their results as they get ready."""

from __future__ import annotations

from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable

_QUEUED_PER_WORKER = 2  # enough that none waits; a million futures at once would fill the memory
Item = TypeVar("Item")
Result = TypeVar("Result")


def finished(
    pool: Executor, workers: int, work: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[tuple[Item, Future[Result]]]:
    """Do the work for all items.

    The generator shuts the pool down when it is closed, and drops what has not begun by then: use it in ``closing``.

    Args:
        pool: of threads or processes.
        workers: how many it has.
        work: for one item; for processes a function of a module.
        items: taken up as the pool gets through them.

    Yields:
        Each item with its finished future (``result`` raises what the work raised), in no particular order.
    """
    waiting = iter(items)

    def begun(n: int) -> dict[Future[Result], Item]:
        return {pool.submit(work, item): item for item in islice(waiting, n)}

    try:
        running = begun(workers * _QUEUED_PER_WORKER)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            ready = [(running.pop(future), future) for future in done]
            running |= begun(len(ready))
            yield from ready
    finally:
        pool.shutdown(cancel_futures=True)


def finished_in_threads(
    workers: int, work: Callable[[Item], Result], items: Iterable[Item]
) -> Generator[tuple[Item, Future[Result]]]:
    """As ``finished``, in threads of this process: for work that shares a model."""
    return finished(ThreadPoolExecutor(workers), workers, work, items)
