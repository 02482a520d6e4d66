"""A run over many images: goes on where an earlier one stopped, ends with a table."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vehanchor.analysis.pipeline import checked_detector
from vehanchor.batch.engines.local import local_rows, local_workers
from vehanchor.batch.engines.ray import ray_rows, require_ray
from vehanchor.batch.row import BatchRow
from vehanchor.batch.table import check_table_path, write_table
from vehanchor.batch.worker import BatchJob, Task
from vehanchor.detection.detector import Detector
from vehanchor.detection.networks import networks_sha256
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.imagery.sources.files import find_images
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import bundled_models, resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.options.option import Limits
from vehanchor.records import SCHEMA_VERSION
from vehanchor.rulers.known_length_table import lines_in
from vehanchor.storage.journal import Journal

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Generator, Iterator, Mapping, Sequence

BatchEngine = Literal["local", "ray"]


@dataclass(frozen=True)
class BatchSummary:
    """The outcome of a finished run.

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
    engine: BatchEngine = "local",
    address: str | None = None,
    workers: int | None = None,
    detector: str | os.PathLike[str] | None = None,
    classes: Sequence[str | int] | None = None,
    options: ScaleOptions | None = None,
    known_lengths: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    runtime: Runtime | None = None,
) -> BatchSummary:
    """Estimate the scale of many images: a table with a row for each.

    Rows are the same whichever engine and however many workers, and stand in the order of ``find_images``. Until the
    table is complete they are kept in ``<output>.journal``: the same call after an interruption makes only those that
    are missing, or whose image has changed. An image that cannot be read is a row with ``error_code`` and ``error``.

    Args:
        inputs: directories, patterns and files; see ``find_images``.
        output: ``.parquet`` (extra ``parquet``), ``.csv`` or ``.jsonl``.
        engine: ``local`` for processes of this machine, ``ray`` (extra ``ray``) for Ray Data with a model per actor.
        address: of a Ray cluster; None starts one here.
        workers: models at work at once; default one a CPU of the machine or cluster.
        detector: name of a bundled model or path of an ONNX file; default the bundled one.
        classes: of the model, by name or index, that count as vehicles; default the model's own.
        options: every choice of the method, without a frame.
        known_lengths: a CSV of lines of known length in single images; see ``read_known_lengths``.
        overwrite: start anew; a complete table stays until the new one is complete.
        runtime: providers and precision of the models, each on one thread; its progress gets (images done, images in
            all).

    Raises:
        ImageNotFoundError: a directory that does not exist, a directory or pattern without images.
        InvalidParameterError: an option has no meaning, or an unfinished run at ``output`` had others.
        KnownLengthError: the CSV cannot be used, or names another image.
        OutputError: the table exists, or cannot be written.
        ModelError: the detector cannot be used.
        MissingExtraError: Ray or pyarrow is not installed.
        WorkerDiedError: a worker was killed.
    """
    table, chosen, told = check_table_path(Path(output)), options or ScaleOptions(), runtime or Runtime()
    _check(engine, address, workers, chosen)
    _check_unfinished(table, overwrite)
    tasks = list(map(Task.of, find_images(inputs, leave_out=(table, journal_path(table)))))
    lines = lines_in(known_lengths, [task.path for task in tasks])
    job = replace(_job(detector, classes, chosen, replace(told.idle, threads=1)), known_lengths=lines)
    journal = open_journal(table, job, anew=overwrite)  # the table itself stays until the new one is whole
    keys = {task.file: task.key() for task in tasks}  # of the images as they are now
    missing = [task for task in tasks if keys[task.file] not in journal]
    with closing(_rows(engine, job, missing, workers, address)) as rows:
        for row in _counting(rows, len(tasks) - len(missing), len(tasks), told.tell):
            journal.add(keys[row.file], row)
    statuses = _write(table, journal.values(keys[task.file] for task in tasks))
    journal.remove()
    return BatchSummary(table, len(tasks), len(tasks) - len(missing), statuses)


def journal_path(table: Path) -> Path:
    """Path of the file that keeps the rows of a table until it is complete."""
    return table.with_name(table.name + ".journal")


def open_journal(table: Path, job: BatchJob, *, anew: bool = False) -> Journal[BatchRow]:
    """Open the rows so far of a table; with ``anew``, none.

    Raises:
        InvalidParameterError: they are those of another job, or the file is no journal.
        OutputError: it cannot be written.
    """
    if anew:
        journal_path(table).unlink(missing_ok=True)
    return Journal(
        journal_path(table),
        _settings(job),
        dump=lambda row: row.model_dump(mode="json"),
        load=lambda value: BatchRow.model_validate_json(json.dumps(value)),
        sole=True,
        remedy="move the file away, or start anew with --overwrite",
    )


def _settings(job: BatchJob) -> dict[str, Any]:
    """Collect what the rows depend on: neither engine nor workers nor threads."""
    options = asdict(job.options)
    del options["frame"]
    if job.known_lengths:
        options["lines_of"] = job.known_lengths
    return {
        "vehanchor": version("vehanchor"),
        "schema_version": SCHEMA_VERSION,
        "networks_sha256": job.networks_sha256,
        "classes": job.classes,
        **options,
    }


def _job(
    detector: str | os.PathLike[str] | None,
    classes: Sequence[str | int] | None,
    options: ScaleOptions,
    runtime: Runtime,
) -> BatchJob:
    """Load the model once, so that what is wrong with it is told before the work."""
    named = tuple(classes) if classes else None
    path = resolve_model(None if detector is None else str(detector), runtime.precision)
    model = checked_detector(Detector(path, classes=named, runtime=runtime), options)
    bundled = model.path in bundled_models().values()  # elsewhere in the cluster it may lie elsewhere
    name = model.path.stem if bundled else str(model.path.resolve())
    return BatchJob(name, networks_sha256(model.card), named, options, runtime)


def _check(engine: str, address: str | None, workers: int | None, options: ScaleOptions) -> None:
    if engine not in ("local", "ray"):
        raise InvalidParameterError(f"engine is {engine!r}: use local or ray")
    if engine == "ray":
        require_ray()
    elif address is not None:
        raise InvalidParameterError("an address is that of a Ray cluster: add --engine ray")
    if workers is not None:
        Limits(least=1, whole=True).check("workers", workers)
    if options.frame.size is not None:
        raise InvalidParameterError("a frame belongs to one image: a batch has none")


def _check_unfinished(table: Path, overwrite: bool) -> None:
    if table.exists() and not journal_path(table).exists() and not overwrite:
        raise OutputError(f"{str(table)!r} is there already and complete: name another file, or pass --overwrite")


def _rows(
    engine: BatchEngine, job: BatchJob, tasks: Sequence[Task], workers: int | None, address: str | None
) -> Generator[BatchRow]:
    if not tasks:
        return
    if engine == "ray":
        yield from ray_rows(job, tasks, workers, address)
    else:
        yield from local_rows(job, tasks, min(workers or local_workers(len(tasks)), len(tasks)))


def _counting(
    rows: Iterator[BatchRow], n_done: int, n_tasks: int, tell: Callable[[int, int], None]
) -> Iterator[BatchRow]:
    """The same rows, the progress told when each has been dealt with."""
    tell(n_done, n_tasks)
    for number, row in enumerate(rows, start=n_done + 1):
        yield row
        tell(number, n_tasks)


def _write(table: Path, rows: Iterator[BatchRow]) -> dict[str, int]:
    """Write the table; returns how many rows have each status."""
    statuses: Counter[str] = Counter()

    def counted() -> Iterator[BatchRow]:
        for row in rows:
            statuses["error" if row.estimate is None else row.estimate.status] += 1
            yield row

    write_table(table, counted())
    return dict(statuses)
