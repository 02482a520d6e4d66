"""Workers as processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import TYPE_CHECKING

from vehanchor.batch.worker import Worker
from vehanchor.errors import WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor.batch.row import BatchRow
    from vehanchor.batch.worker import BatchJob, Task

_TASKS_PER_WORKER = 2  # one is computed, one waits
_worker: Worker | None = None  # in a worker process


def local_workers(n_tasks: int) -> int:
    """Choose one worker per CPU: single-threaded workers are faster than one worker with all threads."""
    cpus = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cpus, n_tasks))


def local_rows(job: BatchJob, tasks: Sequence[Task], workers: int) -> Iterator[BatchRow]:
    """Make the rows of all tasks.

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
        yield from map(Worker(job).row, tasks)
        return
    context = multiprocessing.get_context("spawn")  # a forked process with threads can deadlock
    pool = ProcessPoolExecutor(workers, context, _start, (job,))
    waiting = iter(tasks)
    try:
        running = {pool.submit(_row, task) for task in islice(waiting, _TASKS_PER_WORKER * workers)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            running |= {pool.submit(_row, task) for task in islice(waiting, len(done))}
            for future in done:
                yield future.result()
    except BrokenProcessPool:
        raise WorkerDiedError(
            f"a worker process died, usually for lack of memory: each of {workers} held a model "
            "and an image. Finished rows are kept; run the same command again with fewer --workers"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


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
