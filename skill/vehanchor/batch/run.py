"""Run of a batch: the scales of many images, in a table with one row per image.

A run may take days and may be interrupted. It therefore has five steps:

1. Check all arguments, list the images, and load the model once, so that errors come at once.
2. Open the journal beside the table. It holds the finished rows of an interrupted run.
3. Compute the missing rows, on this machine or on a Ray cluster. Each row goes to the journal at
   once.
4. Write the table, with the rows in the order of the images.
5. Delete the journal. A table without a journal is therefore complete.
"""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.analysis.pipeline import checked_detector
from vehanchor.batch.engines.local import local_rows, local_workers
from vehanchor.batch.engines.ray import ray_rows, require_ray
from vehanchor.batch.row import BatchRow
from vehanchor.batch.table import check_table_path, write_table
from vehanchor.batch.worker import BatchJob, Task
from vehanchor.detection.detector import networks_sha256
from vehanchor.engine import Engine
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.files import find_images
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import bundled_models
from vehanchor.options import ScaleOptions
from vehanchor.options.option import Limits
from vehanchor.pictures.overlays import Overlays
from vehanchor.records import SCHEMA_VERSION
from vehanchor.records.columns import ALL_COLUMNS, COLUMNS
from vehanchor.rulers.known_length_table import lines_in
from vehanchor.storage.atomic import beside
from vehanchor.storage.journal import Journal

if TYPE_CHECKING:
    import os
    from collections.abc import Generator, Iterator, Mapping, Sequence

    from vehanchor.storage.journal import Key


class Cause(NamedTuple):
    """Rows without a usable scale that have the same reason and the same remedy.

    Attributes:
        n_rows: number of these rows.
        first: the first of them.
    """

    n_rows: int
    first: BatchRow


@dataclass(frozen=True)
class BatchSummary:
    """Summary of a finished run.

    Attributes:
        table: the file written.
        n_rows: its number of rows, one per image.
        n_resumed: number of rows from an interrupted run.
        statuses: number of rows by status; ``error`` counts rows with an error.
        causes: why scales are not usable, the most frequent cause first.
    """

    table: Path
    n_rows: int
    n_resumed: int
    statuses: Mapping[str, int]
    causes: Sequence[Cause]


def run_batch(
    inputs: Sequence[str],
    output: str | os.PathLike[str],
    *,
    engine: str = "local",
    address: str | None = None,
    workers: int | None = None,
    detector: str | os.PathLike[str] | None = None,
    classes: Sequence[str | int] | None = None,
    options: ScaleOptions | None = None,
    known_lengths: str | os.PathLike[str] | None = None,
    details: bool = False,
    overlays: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    runtime: Runtime | None = None,
    isolated: bool = False,
) -> BatchSummary:
    """Estimate the scales of many images, and write a table with one row per image.

    Rows do not depend on the engine or the number of workers; their order is that of
    ``find_images``. Until the table is complete, ``<output>.journal`` keeps the finished rows, and
    the same call resumes an interrupted run. An unreadable image has a row with ``error_code`` and
    ``error``.

    Args:
        inputs: directories, patterns and files; see ``find_images``.
        output: the table; its suffix selects the format (``write_table``).
        engine: ``local`` for processes of this machine, ``ray`` (extra ``ray``) for Ray Data.
        address: address of a Ray cluster; None starts one on this machine.
        workers: number of models that work in parallel; None for one per CPU of the machine or
            cluster.
        detector: name of a bundled model or path of an ONNX file; None for the bundled default.
        classes: classes of the model that count as vehicles; None for the model's own.
        options: options of the method, without a frame; None for the defaults.
        known_lengths: CSV with lines of known length by image; see ``lines_in``.
        details: write all columns.
        overlays: folder of a picture of each image with its vehicles; made if missing. Not with
            Ray.
        overwrite: start again, although rows of an interrupted run exist. An existing table stays
            until the new one is complete.
        runtime: providers of the models, each on one thread, and the progress in images.
        isolated: whether a single worker has a process of its own, which imports the main module.

    Raises:
        ImageNotFoundError: a directory does not exist, or a directory or pattern has no image.
        InvalidParameterError: an option is invalid, or an unfinished run at ``output`` had other
            options.
        KnownLengthError: the CSV cannot be used, or names an image that is not in the run.
        OutputError: the table cannot be written.
        ModelError: the detector cannot be used.
        MissingExtraError: Ray or pyarrow is not installed.
        WorkerDiedError: a worker died before it had an image, or Ray ended the run.
    """
    table = Path(output)
    options = options or ScaleOptions()
    runtime = runtime or Runtime()
    check_table_path(table)
    _check_arguments(engine, address, workers=workers, options=options)

    paths = find_images(inputs)
    tasks = [Task.of(path) for path in paths]
    lines_by_image = lines_in(known_lengths, [task.path for task in tasks])
    job = _make_job(detector, classes, options=options, runtime=runtime)
    job = replace(job, known_lengths=lines_by_image, overlays=_overlays(overlays, engine, tasks))
    with open_journal(table, job, anew=overwrite) as journal:
        # A key contains the state of its image, so the row of a replaced image is missing.
        keys = {task: task.key() for task in tasks}
        missing = [task for task in tasks if keys[task] not in journal or _lacks(task, job)]
        n_resumed = len(tasks) - len(missing)
        runtime.report_progress(n_resumed, len(tasks))
        # Closing the generator stops the workers if this process is interrupted.
        new_rows = _compute_rows(engine, address, job, missing, workers=workers, isolated=isolated)
        with closing(new_rows):
            for n_finished, (task, row) in enumerate(new_rows, n_resumed + 1):
                journal.add(keys[task], row)
                runtime.report_progress(n_finished, len(tasks))
        keys_in_order = [keys[task] for task in tasks]
        statuses, causes = _write_rows(table, journal, keys_in_order, details=details)
        journal.remove()
    return BatchSummary(table, len(tasks), n_resumed, statuses=statuses, causes=causes)


def _overlays(
    folder: str | os.PathLike[str] | None, engine: str, tasks: Sequence[Task]
) -> Overlays | None:
    """Place the pictures of a run; None without them.

    Raises:
        InvalidParameterError: the engine has other machines.
    """
    if folder is None:
        return None
    if engine != "local":
        raise InvalidParameterError("overlays lie on this machine: leave out --engine ray")
    return Overlays.of(folder, [task.path for task in tasks])


def _lacks(task: Task, job: BatchJob) -> bool:
    """Check whether an image has a row of an interrupted run, but no picture."""
    return job.overlays is not None and not job.overlays.path(task.path).exists()


def _check_arguments(
    engine: str, address: str | None, *, workers: int | None, options: ScaleOptions
) -> None:
    """Check the engine and its settings, and refuse options that belong to one image."""
    if engine not in ("local", "ray"):
        raise InvalidParameterError(f"engine is {engine!r}: use local or ray")
    if engine == "ray":
        require_ray()
    elif address is not None:
        raise InvalidParameterError("an address needs a Ray cluster: add --engine ray")
    if workers is not None:
        Limits(least=1, whole=True).check("workers", workers)
    if options.frame.size is not None:
        raise InvalidParameterError("a frame belongs to one image: leave it out for a batch")
    options.check_for_several_images()


def _make_job(
    detector: str | os.PathLike[str] | None,
    classes: Sequence[str | int] | None,
    *,
    options: ScaleOptions,
    runtime: Runtime,
) -> BatchJob:
    """Make the settings of the workers; load the model once to find its errors before the work."""
    # One thread per model: many single-threaded workers are faster than one with all threads.
    worker_runtime = replace(runtime.idle, threads=1)
    vehicle_classes = tuple(classes) if classes else None
    engine = Engine(detector, classes=vehicle_classes, runtime=worker_runtime)
    model = checked_detector(engine.detector, options)

    # Workers load the model again. On other machines of a cluster, bundled models may have other
    # paths, so workers find them by name.
    detector_name = str(model.path.resolve())
    if model.path in bundled_models().values():
        detector_name = model.path.stem
    return BatchJob(
        detector=detector_name,
        networks_sha256=networks_sha256(model.card),
        classes=vehicle_classes,
        options=options,
        runtime=worker_runtime,
    )


def _compute_rows(
    engine: str,
    address: str | None,
    job: BatchJob,
    tasks: Sequence[Task],
    *,
    workers: int | None,
    isolated: bool,
) -> Generator[tuple[Task, BatchRow]]:
    """Compute the rows of all tasks, in order of completion."""
    if not tasks:
        return
    if engine == "ray":
        yield from ray_rows(job, tasks, workers=workers, address=address)
    else:
        n_tasks = len(tasks)
        n_workers = workers or local_workers(n_tasks)
        is_pool = n_workers > 1 or isolated
        yield from local_rows(job, tasks, min(n_workers, n_tasks), isolated=is_pool)


def journal_path(table: Path) -> Path:
    """Return the path of the journal of a table."""
    return beside(table, ".journal")


def open_journal(table: Path, job: BatchJob, *, anew: bool = False) -> Journal[BatchRow]:
    """Open the journal of a table, and lock it against other runs.

    Args:
        table: the table; the journal lies beside it.
        job: settings of the run; rows of other settings are refused.
        anew: discard the rows of earlier runs.

    Raises:
        InvalidParameterError: the rows belong to another job, or the file is not a journal.
        OutputError: the journal cannot be written, or another run is using it.
    """
    return Journal(
        journal_path(table),
        _row_settings(job),
        dump=lambda row: row.model_dump(mode="json"),
        load=lambda value: BatchRow.model_validate_json(json.dumps(value)),
        sole=True,
        anew=anew,
        remedy="move the file away, or start again with --overwrite",
    )


def _row_settings(job: BatchJob) -> dict[str, Any]:
    """Collect all settings that rows depend on; engine, workers and threads do not change a row."""
    options = asdict(job.options)
    del options["frame"]
    if job.known_lengths:
        fields_by_image = {}
        for image, lines in job.known_lengths.items():
            fields_by_image[image] = [asdict(line) for line in lines]
        options["lines_of"] = fields_by_image
    return {
        "vehanchor": version("vehanchor"),
        "schema_version": SCHEMA_VERSION,
        "networks_sha256": job.networks_sha256,
        "classes": job.classes,
        **options,
    }


def _write_rows(
    table: Path, journal: Journal[BatchRow], keys: Sequence[Key], *, details: bool
) -> tuple[Mapping[str, int], Sequence[Cause]]:
    """Write the rows of a complete journal to the table, and count them.

    Returns:
        Number of rows by status; causes of scales that are not usable, the most frequent first.
    """
    statuses: Counter[str] = Counter()
    causes: dict[tuple[str | None, str], Cause] = {}

    def count(row: BatchRow) -> None:
        statuses[row.outcome] += 1
        advice = row.advice
        if advice is None:
            return
        reason_and_remedy = (row.reason, advice.helps)
        n_before, first = causes.get(reason_and_remedy, (0, row))
        causes[reason_and_remedy] = Cause(n_before + 1, first)

    def counted_rows() -> Iterator[Mapping[str, Any]]:
        # Millions of rows may not fit in memory: read, count and write them one by one.
        for key in keys:
            row = journal.get(key)
            assert row is not None  # The journal is complete.
            count(row)
            yield row.flat()

    columns = ALL_COLUMNS if details else COLUMNS
    write_table(table, counted_rows(), columns)
    most_frequent_first = sorted(causes.values(), key=lambda cause: -cause.n_rows)
    return dict(statuses), tuple(most_frequent_first)
