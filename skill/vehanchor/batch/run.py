"""A run over many images: goes on where an earlier one stopped, ends with a table."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vehanchor.batch.engines.local import local_rows, local_workers
from vehanchor.batch.engines.ray import ray_rows, require_ray
from vehanchor.batch.files import find_images
from vehanchor.batch.journal import Journal, journal_path
from vehanchor.batch.table import check_table_path, write_table
from vehanchor.batch.worker import BatchJob, Task
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.estimate import ScaleOptions, open_detector
from vehanchor.models.session import DEFAULT_PROVIDERS
from vehanchor.models.zoo import bundled_models, resolve_model

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from vehanchor.batch.row import BatchRow

__all__ = ["BatchSummary", "Engine", "run_batch"]

Engine = Literal["local", "ray"]


@dataclass(frozen=True)
class BatchSummary:
    """What a finished run did.

    Attributes:
        table: the file written.
        n_rows: its rows, one an image.
        n_resumed: rows of them that an earlier, interrupted run had made.
        statuses: how many rows have each status; ``error`` counts those with an error.
    """

    table: Path
    n_rows: int
    n_resumed: int
    statuses: Mapping[str, int]


def run_batch(
    inputs: Sequence[str],
    output: str | os.PathLike[str],
    *,
    engine: Engine = "local",
    address: str | None = None,
    workers: int | None = None,
    detector: str | os.PathLike[str] | None = None,
    options: ScaleOptions | None = None,
    providers: Sequence[str] = DEFAULT_PROVIDERS,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> BatchSummary:
    """Estimate the scale of many images and write a table with a row for each.

    Rows are the same whichever engine and however many workers, and stand in the order of ``find_images``. Until the
    table is complete they are kept in ``<output>.journal``: the same call after an interruption makes only those that
    are missing. An image that cannot be read is a row with ``error_code`` and ``error``.

    Args:
        inputs: directories, patterns and files; see ``find_images``.
        output: ``.parquet`` (extra ``parquet``), ``.csv`` or ``.jsonl``.
        engine: ``local`` for processes of this machine, ``ray`` (extra ``ray``) for Ray Data with a model per actor.
        address: of a Ray cluster; None starts a Ray on this machine for the run.
        workers: models at work at once; default one a CPU of the machine or cluster.
        detector: a bundled model's name or the path of an ONNX file; default the bundled one.
        options: every choice of the method, without ``frame``.
        providers: execution providers of ONNX Runtime, in order of preference.
        overwrite: start anew, whatever an earlier run left.
        progress: called with (images done, images in all).

    Returns:
        What was written.

    Raises:
        ImageNotFoundError: a directory or pattern without images.
        InvalidParameterError: an option has no meaning, or an unfinished run at ``output`` had others.
        OutputError: the table exists, or cannot be written.
        ModelError: the detector cannot be used.
        MissingExtraError: Ray or pyarrow is not installed.
        WorkerDiedError: a worker was killed.
    """
    table = check_table_path(Path(output))
    _check(engine, address, workers, options)
    journal_file = journal_path(table)
    if overwrite:
        table.unlink(missing_ok=True)
        journal_file.unlink(missing_ok=True)
    elif table.exists():
        raise OutputError(f"{str(table)!r} is there already and complete: name another file, or pass --overwrite")
    tasks = [Task.of(path) for path in find_images(inputs, leave_out=(table, journal_file))]
    chosen = options or ScaleOptions()
    model = open_detector(Detector(resolve_model(None if detector is None else str(detector))), chosen)
    bundled = model.path in bundled_models().values()  # elsewhere in the cluster it may lie elsewhere
    job = BatchJob(
        model.path.stem if bundled else str(model.path.resolve()), model.card.sha256, chosen, tuple(providers)
    )
    with Journal(journal_file, _basis(job)) as journal:
        missing = [task for task in tasks if task.file not in journal]
        n_done = n_resumed = len(tasks) - len(missing)
        if progress is not None:
            progress(n_done, len(tasks))
        for row in _rows(engine, job, missing, workers, address):
            journal.add(row)
            n_done += 1
            if progress is not None:
                progress(n_done, len(tasks))
        statuses: Counter[str] = Counter()
        write_table(table, _counted(journal.rows([task.file for task in tasks]), statuses))
    journal_file.unlink()
    return BatchSummary(table, len(tasks), n_resumed, dict(statuses))


def _check(engine: str, address: str | None, workers: int | None, options: ScaleOptions | None) -> None:
    if engine not in ("local", "ray"):
        raise InvalidParameterError(f"engine is {engine!r}: use local or ray")
    if engine == "ray":
        require_ray()
    elif address is not None:
        raise InvalidParameterError("an address is that of a Ray cluster: add --engine ray")
    if workers is not None and workers < 1:
        raise InvalidParameterError(f"workers is {workers}: use a whole number >= 1")
    if options is not None and options.frame_width_px is not None:
        raise InvalidParameterError("a frame belongs to one image: a batch has none")


def _rows(
    engine: Engine, job: BatchJob, tasks: Sequence[Task], workers: int | None, address: str | None
) -> Iterator[BatchRow]:
    if not tasks:
        return iter(())
    if engine == "ray":
        return ray_rows(job, tasks, workers, address)
    return local_rows(job, tasks, min(workers or local_workers(len(tasks)), len(tasks)))


def _basis(job: BatchJob) -> dict[str, Any]:
    """What the rows depend on: neither engine nor workers nor threads."""
    options = {name: value for name, value in asdict(job.options).items() if not name.startswith("frame")}
    basis = {"vehanchor": version("vehanchor"), "model_sha256": job.detector_sha256, **options}
    plain: dict[str, Any] = json.loads(json.dumps(basis, default=lambda record: record.model_dump(mode="json")))
    return plain


def _counted(rows: Iterator[BatchRow], statuses: Counter[str]) -> Iterator[BatchRow]:
    for row in rows:
        statuses["error" if row.estimate is None else row.estimate.status] += 1
        yield row
