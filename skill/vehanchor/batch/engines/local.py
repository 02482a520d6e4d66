"""Workers as processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from typing import TYPE_CHECKING

from vehanchor.batch.pool import finished
from vehanchor.batch.worker import Worker
from vehanchor.errors import WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor.batch.row import BatchRow
    from vehanchor.batch.worker import BatchJob, Task

_worker: Worker | None = None  # in a worker process


def local_workers(n_tasks: int) -> int:
    """Choose one worker per CPU: single-threaded workers are faster than one worker with all threads."""
    return max(
        1, min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, n_tasks)
    )


def local_rows(job: BatchJob, tasks: Sequence[Task], workers: int) -> Iterator[BatchRow]:
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
        only = Worker(job)
        yield from map(only.row, tasks)
        return
    context = multiprocessing.get_context("spawn")  # a forked process with threads can deadlock
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(job,))
    try:
        with closing(finished(pool, workers, _row, tasks)) as rows:
            for _, future in rows:
                yield future.result()
    except BrokenProcessPool:
        raise WorkerDiedError(
            f"a worker process died, usually for lack of memory: each of {workers} held a model and an image. Finished "
            "rows are kept; run the same command again with fewer --workers"
        ) from None


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


def _row(task: Task) -> BatchRow:
    assert _worker is not None  # the pool starts a process with _start
    return _worker.row(task)
