"""Engine with processes of this machine as workers."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

from vehanchor.analysis.heap import huge_pages_in_new_processes, use_one_heap
from vehanchor.analysis.isolated_process import (
    IsolatedProcess,
    ignore_interrupts_and_end_with_parent,
)
from vehanchor.batch.row import BatchRow
from vehanchor.batch.worker import Worker
from vehanchor.errors import WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

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
    job: BatchJob, tasks: Sequence[Task], workers: int, *, isolated: bool = True
) -> Iterator[tuple[Task, BatchRow]]:
    """Make the rows of all tasks.

    An image whose worker dies twice, the second time alone in its process, has a row with the
    error; the run goes on.

    Args:
        job: settings of the workers.
        tasks: the images.
        workers: number of processes.
        isolated: False uses this process alone, if there is one worker.

    Yields:
        Each task with its row, in order of completion.

    Raises:
        WorkerDiedError: a process died before it had an image, usually for lack of memory.
        ModelError: the model cannot be loaded.
    """
    if workers == 1 and not isolated:
        worker = Worker(job)
        for task in tasks:
            yield task, worker.row(task)
        return

    waiting = iter(tasks)
    in_flight: dict[Future[BatchRow], Task] = {}
    alone = IsolatedWorker(job)
    try:
        while True:
            pool = _pool(job, workers)
            try:
                yield from _rows_of_pool(pool, waiting, in_flight, workers=workers)
                return
            except BrokenProcessPool:
                # The pool does not tell whose worker died: each image has a process of its own.
                suspects = list(in_flight.values())
                in_flight.clear()
            finally:
                pool.shutdown(cancel_futures=True)
            for task in suspects:
                yield task, alone.row(task)
    finally:
        alone.close()


def _rows_of_pool(
    pool: ProcessPoolExecutor,
    waiting: Iterator[Task],
    in_flight: dict[Future[BatchRow], Task],
    *,
    workers: int,
) -> Iterator[tuple[Task, BatchRow]]:
    """Make rows in a pool until all tasks are done, or the pool breaks.

    Args:
        pool: the pool.
        waiting: tasks that have not been submitted.
        in_flight: submitted tasks without a row, by their futures.
        workers: number of processes of the pool.

    Yields:
        Each task with its row, in order of completion.

    Raises:
        BrokenProcessPool: a process died; ``in_flight`` holds the tasks that have no row.
    """
    # Submit a few tasks at a time: a million futures would fill the memory.
    n_new = _TASKS_PER_WORKER * workers
    while True:
        for task in islice(waiting, n_new):
            in_flight[_submit(pool, task)] = task
        if not in_flight:
            return
        done, _ = wait(in_flight, return_when=FIRST_COMPLETED)
        for future in done:
            row = future.result()
            yield in_flight.pop(future), row
        n_new = len(done)


def _submit(pool: ProcessPoolExecutor, task: Task) -> Future[BatchRow]:
    """Submit a task; a broken pool returns a future with its error, so that no task is lost."""
    try:
        # The first tasks start the pool's processes.
        with huge_pages_in_new_processes():
            return pool.submit(_make_row, task)
    except BrokenProcessPool as error:
        failed: Future[BatchRow] = Future()
        failed.set_exception(error)
        return failed


class IsolatedWorker:
    """Worker in a process of its own, which is replaced after it has died.

    Args:
        job: settings of the worker.
    """

    def __init__(self, job: BatchJob) -> None:
        self._process: IsolatedProcess[Task, BatchRow] = IsolatedProcess(
            partial(_row_maker, job),
            remedy="Finished rows are kept; run the same command again with fewer --workers",
        )

    def row(self, task: Task) -> BatchRow:
        """Make the row of one image; the death of the process goes into the row, too.

        Raises:
            WorkerDiedError: the process died before it had the image.
            ModelError: the model cannot be loaded.
        """
        self._process.start()
        try:
            return self._process.run(task)
        except WorkerDiedError as error:
            return BatchRow.failed(task.file, error)

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _row_maker(job: BatchJob) -> Callable[[Task, object], BatchRow]:
    """Prepare an isolated process; return the function that makes rows."""
    worker = Worker.for_this_process(job)

    def make_row(task: Task, _: object) -> BatchRow:
        return worker.row(task)

    return make_row


def _pool(job: BatchJob, workers: int) -> ProcessPoolExecutor:
    """Make a pool of processes, each with a worker."""
    # A forked copy of a process with threads can deadlock, so each worker starts anew.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        workers, mp_context=context, initializer=_start_worker, initargs=(job,)
    )


def _start_worker(job: BatchJob) -> None:
    """Make this process a worker; it ignores Ctrl-C, and ends with its parent."""
    global _worker
    use_one_heap()
    ignore_interrupts_and_end_with_parent()
    _worker = Worker.for_this_process(job)


def _make_row(task: Task) -> BatchRow:
    assert _worker is not None  # The pool starts each process with _start_worker.
    return _worker.row(task)
