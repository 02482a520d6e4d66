"""Engine with processes of this machine as workers."""

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

# Each worker computes one task while the next one waits for it.
_TASKS_PER_WORKER = 2
# The worker of this process, if a pool has started the process.
_worker: Worker | None = None


def local_workers(n_tasks: int) -> int:
    """Choose one worker per CPU that this process may use.

    Many single-threaded workers are faster than one worker with all threads.
    """
    if hasattr(os, "sched_getaffinity"):
        n_cpus = len(os.sched_getaffinity(0))
    else:
        n_cpus = os.cpu_count() or 1
    return max(1, min(n_cpus, n_tasks))


def local_rows(
    job: BatchJob, tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, BatchRow]]:
    """Make the rows of all tasks.

    Args:
        job: settings of the workers.
        tasks: the images.
        workers: number of processes; 1 uses this process alone.

    Yields:
        Each task with its row, in order of completion.

    Raises:
        WorkerDiedError: a process was killed, usually for lack of memory.
        ModelError: the model cannot be loaded.
    """
    if workers == 1:
        worker = Worker(job)
        for task in tasks:
            yield task, worker.row(task)
        return

    # A forked copy of a process with threads can deadlock, so each worker starts anew.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(
        workers, mp_context=context, initializer=_start_worker, initargs=(job,)
    )
    waiting = iter(tasks)
    try:
        # Submit a few tasks at a time: a million futures would fill the memory.
        first_tasks = islice(waiting, _TASKS_PER_WORKER * workers)
        running = {pool.submit(_make_row, task) for task in first_tasks}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            next_tasks = islice(waiting, len(done))
            running |= {pool.submit(_make_row, task) for task in next_tasks}
            for future in done:
                yield future.result()
    except BrokenProcessPool:
        raise WorkerDiedError(
            f"a worker process died, usually for lack of memory: each of {workers} held a model "
            "and an image. Finished rows are kept; run the same command again with fewer --workers"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(job: BatchJob) -> None:
    """Make this process a worker; it ignores Ctrl-C, and ends with its parent."""
    global _worker
    # The terminal sends Ctrl-C to all processes; the parent alone ends the run.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _worker = Worker.for_this_process(job)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_row(task: Task) -> tuple[Task, BatchRow]:
    assert _worker is not None  # The pool starts each process with _start_worker.
    return task, _worker.row(task)
