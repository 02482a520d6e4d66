"""Engine with actors of Ray as workers: on a cluster, or on this machine for one run."""

from __future__ import annotations

import logging
import math
import os
import socket
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from vehanchor.batch.engines.local import IsolatedWorker
from vehanchor.batch.row import BatchRow
from vehanchor.batch.worker import Task
from vehanchor.errors import (
    InvalidParameterError,
    MissingExtraError,
    WorkerDiedError,
    how_to_install,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor.batch.worker import BatchJob

_KNOCK_TIMEOUT_S = 10.0
# A block is the work that each worker loses at most if the run is interrupted.
_IMAGES_PER_BLOCK = 8


def require_ray() -> Any:
    """Import Ray with Ray Data.

    Raises:
        MissingExtraError: Ray is not installed.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # no telemetry from a library
    try:
        import ray
        import ray.data
    except ImportError:
        raise MissingExtraError(
            f"--engine ray needs Ray: {how_to_install('ray')}, or use --engine local"
        ) from None
    return ray


class _Actor:
    """Actor with one model; Ray Data calls it with blocks of tasks.

    The model has a process of its own: Ray would start an actor that a decoder ends again and
    again, for the same image.
    """

    def __init__(self) -> None:
        self._worker: IsolatedWorker | None = None

    def __call__(self, block: dict[str, Any], job: BatchJob) -> dict[str, Any]:
        # The constructor does not load the model, because Ray warns of its arguments.
        if self._worker is None:
            self._worker = IsolatedWorker(job)
        rows = []
        for file, path in zip(block["file"], block["path"], strict=True):
            task = Task(str(file), os.fsdecode(path))
            row = self._worker.row(task)
            rows.append(row.model_dump_json())
        return {"number": block["number"], "row": rows}


def ray_rows(
    job: BatchJob, tasks: Sequence[Task], workers: int | None, address: str | None
) -> Iterator[tuple[Task, BatchRow]]:
    """Make the rows of all tasks.

    Args:
        job: settings of the workers; all machines need the same vehanchor and the same image paths.
        tasks: the images.
        workers: number of actors; None for one per CPU of the cluster.
        address: address of the cluster (``auto``, ``host:6379``, ``ray://host:10001``); None starts
            a local Ray.

    Yields:
        Each task with its row, in order of completion.

    Raises:
        MissingExtraError: Ray is not installed.
        InvalidParameterError: there is no cluster at the address.
        WorkerDiedError: an actor was lost, and Ray could not replace it.
    """
    ray = require_ray()
    with _quiet(), _cluster(ray, address):
        # The command shows its own progress.
        ray.data.DataContext.get_current().enable_progress_bars = False
        n_workers = min(workers or _cluster_cpus(ray), len(tasks))
        min_blocks = math.ceil(len(tasks) / _IMAGES_PER_BLOCK)
        n_blocks = max(n_workers, min_blocks)
        # A name of a file can hold bytes that are not UTF-8, and Arrow's strings cannot.
        items = [
            {"number": number, "file": task.file, "path": os.fsencode(task.path)}
            for number, task in enumerate(tasks)
        ]
        blocks = ray.data.from_items(items, override_num_blocks=n_blocks)
        rows = blocks.map_batches(
            _Actor,
            batch_size=None,  # Each call gets a whole block.
            batch_format="numpy",
            compute=ray.data.ActorPoolStrategy(size=n_workers),
            num_cpus=job.runtime.threads,
            fn_kwargs={"job": job},
        )
        try:
            for row in rows.iter_rows():
                yield tasks[int(row["number"])], BatchRow.model_validate_json(row["row"])
        except ray.exceptions.RayError as error:
            # The last line of Ray's long message names the cause.
            lines = str(error).strip().splitlines() or [type(error).__name__]
            raise WorkerDiedError(
                f"Ray ended the run ({lines[-1]}). Finished rows are kept; run the same command "
                "again to resume"
            ) from None


def _cluster_cpus(ray: Any) -> int:
    n_cpus = ray.cluster_resources().get("CPU", 1)
    return max(1, int(n_cpus))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Ray's log of starts and stops on stderr, which is for the user."""
    loggers = [logging.getLogger(name) for name in ("ray", "ray.data")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def _cluster(ray: Any, address: str | None) -> Iterator[None]:
    """Connect to the cluster at the address; without an address, start Ray for the run.

    If this process is connected to a cluster, that cluster is used.
    """
    if ray.is_initialized():
        yield
        return
    try:
        _knock(address)
        ray.init(
            address or "local",
            include_dashboard=False if address is None else None,  # None leaves a cluster's own.
            log_to_driver=False,
            logging_level=logging.CRITICAL,
        )
    except (OSError, ValueError) as error:
        lines = str(error).splitlines() or [type(error).__name__]
        raise InvalidParameterError(
            f"no Ray cluster at {address!r} ({lines[0]}): start one with 'ray start --head', or "
            "leave --address out"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str | None) -> None:
    """Check that the address answers, because Ray itself would try for minutes.

    Raises:
        OSError: nothing answers.
    """
    host_and_port = (address or "").removeprefix("ray://")
    host, _, port = host_and_port.rpartition(":")
    if host and port.isdigit():
        destination = (host.strip("[]"), int(port))
        socket.create_connection(destination, timeout=_KNOCK_TIMEOUT_S).close()
