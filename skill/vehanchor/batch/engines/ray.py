"""Workers as actors of a Ray cluster, or of a local Ray that is started for the run."""

from __future__ import annotations

import logging
import os
import socket
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from vehanchor.batch.row import BatchRow
from vehanchor.batch.worker import Task, Worker
from vehanchor.errors import InvalidParameterError, MissingExtraError, WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor.batch.worker import BatchJob

_KNOCK_S = 10.0
_BLOCK_FILES = 8  # rows per block, the most that each worker loses in an interruption


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
            "--engine ray needs Ray: pip install 'vehanchor[ray]', or use --engine local"
        ) from None
    return ray


class _Actor:
    """Actor with one model; Ray Data calls it with blocks of tasks."""

    def __init__(self) -> None:
        self._worker: Worker | None = None

    def __call__(self, batch: dict[str, Any], job: BatchJob) -> dict[str, Any]:
        if self._worker is None:  # not in __init__: Ray warns of constructors with arguments
            self._worker = Worker.of_own_process(job)
        tasks = [
            Task(str(file), str(path))
            for file, path in zip(batch["file"], batch["path"], strict=True)
        ]
        return {"row": [self._worker.row(task).model_dump_json() for task in tasks]}


def ray_rows(
    job: BatchJob, tasks: Sequence[Task], workers: int | None, address: str | None
) -> Iterator[BatchRow]:
    """Make the rows of all tasks in order of completion.

    Args:
        job: settings of the workers; all machines need the same vehanchor and the same image paths.
        tasks: the images.
        workers: number of actors; None for one per CPU of the cluster.
        address: address of the cluster (``auto``, ``host:6379``, ``ray://host:10001``); None starts
            a local Ray.

    Yields:
        A row for each task, in order of completion.

    Raises:
        MissingExtraError: Ray is not installed.
        InvalidParameterError: there is no cluster at the address.
        WorkerDiedError: an actor was lost, and Ray could not replace it.
    """
    ray = require_ray()
    with _quiet(), _cluster(ray, address):
        ray.data.DataContext.get_current().enable_progress_bars = False  # the command has its own
        n_workers = min(workers or max(1, int(ray.cluster_resources().get("CPU", 1))), len(tasks))
        dataset = ray.data.from_items(
            [asdict(task) for task in tasks],
            override_num_blocks=max(n_workers, -(-len(tasks) // _BLOCK_FILES)),
        ).map_batches(
            _Actor,
            batch_size=None,  # whole blocks
            batch_format="numpy",
            compute=ray.data.ActorPoolStrategy(size=n_workers),
            num_cpus=job.runtime.threads,
            fn_kwargs={"job": job},
        )
        try:
            for item in dataset.iter_rows():
                yield BatchRow.model_validate_json(item["row"])
        except ray.exceptions.RayError as error:
            reason = (
                str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
            )
            raise WorkerDiedError(
                f"Ray ended the run ({reason}). Finished rows are kept; run the same command again "
                "to resume"
            ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Ray's log of starts and stops on stderr, which is for the user."""
    levels = {logger: logger.level for logger in map(logging.getLogger, ("ray", "ray.data"))}
    for logger in levels:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


@contextmanager
def _cluster(ray: Any, address: str | None) -> Iterator[None]:
    """Use the connected Ray, else the one at the address, else start a local one for the run."""
    if ray.is_initialized():
        yield
        return
    try:
        _knock(address)
        ray.init(
            address or "local",
            include_dashboard=False if address is None else None,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
        )
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InvalidParameterError(
            f"no Ray cluster at {address!r} ({reason}): start one with 'ray start --head', or "
            "leave --address out"
        ) from None
    try:
        yield
    finally:
        ray.shutdown()


def _knock(address: str | None) -> None:
    """Check at once that the address answers: Ray itself tries for minutes."""
    host, _, port = (address or "").removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_KNOCK_S).close()
