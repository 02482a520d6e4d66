"""Workers as processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING

from vehanchor.batch.worker import Worker
from vehanchor.errors import WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor.batch.worker import BatchJob, MadeRow, Task

_worker: Worker | None = None  # in a worker process


def local_workers(n_tasks: int) -> int:
    """Choose one worker per CPU: single-threaded workers are faster than one worker with all threads."""
    return max(
        1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, n_tasks)
    )


def local_rows(job: BatchJob, tasks: Sequence[Task], workers: int) -> Iterator[MadeRow]:
    """Make the rows of all tasks in order of completion.

    Args:
        job: settings of the workers.
        tasks: the images.
        workers: number of processes; 1 uses this process.

    Yields:
        A row for each task, in order of completion.

    Raises:
        WorkerDiedError: a process was killed, usually for lack of memory.
        ModelError: the model cannot be loaded.
    """
    if workers == 1:
        yield from Worker(job).rows(tasks)
        return
    context = multiprocessing.get_context("spawn")  # a forked process with threads can deadlock
    # A pool of one process each, so that a worker gets the image that it has decoded ahead.
    pools = [ProcessPoolExecutor(1, context, _start, (job,)) for _ in range(workers)]
    waiting = iter(tasks)
    ahead = [next(waiting, None) for _ in pools]
    running: dict[Future[MadeRow], int] = {}

    def begin(k: int) -> None:
        task, ahead[k] = ahead[k], next(waiting, None)
        if task is not None:
            running[pools[k].submit(_make, task, ahead[k])] = k

    try:
        for k in range(workers):
            begin(k)
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                begin(running.pop(future))
                yield future.result()
    except BrokenProcessPool:
        raise WorkerDiedError(
            f"a worker process died, usually for lack of memory: each of {workers} held a model and an image. Finished "
            "rows are kept; run the same command again with fewer --workers"
        ) from None
    finally:
        for pool in pools:
            pool.shutdown(wait=False, cancel_futures=True)
        for pool in pools:
            pool.shutdown()


def _start(job: BatchJob) -> None:
    """Make this process a worker; it ignores Ctrl-C and ends with its parent."""
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = Worker.of_own_process(job)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make(task: Task, following: Task | None) -> MadeRow:
    assert _worker is not None  # the pool starts a process with _start
    return _worker.make(task, following)
