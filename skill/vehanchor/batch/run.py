"""Resumable runs over many images that end with a table."""

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
from vehanchor.batch.row import ALL_COLUMNS, COLUMNS, BatchRow
from vehanchor.batch.table import check_table_path, write_table
from vehanchor.batch.worker import BatchJob, Task
from vehanchor.detection.detector import Detector, networks_sha256
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
    from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence


class Cause(NamedTuple):
    """Rows without a usable scale that have the same reason and remedy: their number, and the first of them."""

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
        causes: why scales are not usable, the most frequent first.
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
    overwrite: bool = False,
    runtime: Runtime | None = None,
) -> BatchSummary:
    """Estimate the scales of many images, and write a table with a row for each.

    Rows do not depend on the engine or the number of workers; their order is that of
    ``find_images``. Until the table is complete, rows are kept in ``<output>.journal``, from which
    an interrupted call goes on. An unreadable image has a row with ``error_code`` and ``error``.

    Args:
        inputs: directories, patterns and files; see ``find_images``.
        output: the table; its suffix selects the format (``write_table``).
        engine: ``local`` for processes of this machine, ``ray`` (extra ``ray``) for Ray Data with a
            model per actor.
        address: of a Ray cluster; None starts one on this machine.
        workers: number of models; default one per CPU of the machine or cluster.
        detector: name of a bundled model or path of an ONNX file; default the bundled one.
        classes: classes of the model that count as vehicles; default the model's own.
        options: of the method, without a frame.
        known_lengths: CSV with lines of known length by image; see ``lines_in``.
        details: write all columns.
        overwrite: start again; a table stays until the new one is complete.
        runtime: providers of the models, each on one thread; its progress gets (images done, images
            in all).

    Raises:
        ImageNotFoundError: a directory does not exist, or it or a pattern has no image.
        InvalidParameterError: an option is invalid, or an unfinished run at ``output`` had other
            options.
        KnownLengthError: the CSV cannot be used, or names another image.
        OutputError, ModelError: the table exists or cannot be written, or the detector cannot be
        used. MissingExtraError: Ray or pyarrow is not installed.
        WorkerDiedError: a worker was killed.
    """
    table = _unfinished(Path(output), overwrite)
    chosen = options or ScaleOptions()
    told = runtime or Runtime()
    _check(engine, address, workers, chosen)
    tasks = list(map(Task.of, find_images(inputs)))
    job = _job(detector, classes, options=chosen, runtime=replace(told.idle, threads=1))
    job = replace(job, known_lengths=lines_in(known_lengths, [task.path for task in tasks]))
    # the table itself stays until the new one is complete
    with open_journal(table, job, anew=overwrite) as journal:
        keys = {task.file: task.key() for task in tasks}
        missing = [task for task in tasks if keys[task.file] not in journal]
        with closing(_rows(engine, job, missing, workers, address)) as rows:
            told.tell(n_resumed := len(tasks) - len(missing), len(tasks))
            for number, row in enumerate(rows, start=n_resumed + 1):
                journal.add(keys[row.file], row)
                told.tell(number, len(tasks))
        counts = _write_counted(
            table, (journal.get(keys[task.file]) for task in tasks), details=details
        )
        journal.remove()
    return BatchSummary(table, len(tasks), n_resumed, *counts)


def journal_path(table: Path) -> Path:
    """Give the path of the journal of a table."""
    return table.with_name(table.name + ".journal")


def open_journal(table: Path, job: BatchJob, *, anew: bool = False) -> Journal[BatchRow]:
    """Open the journal of a table; ``anew`` discards its rows.

    Raises:
        InvalidParameterError: the rows belong to another job, or the file is not a journal.
        OutputError: it cannot be written.
    """
    return Journal(
        journal_path(table),
        _settings(job),
        dump=lambda row: row.model_dump(mode="json"),
        load=lambda value: BatchRow.model_validate_json(json.dumps(value)),
        sole=True,
        anew=anew,
        remedy="move the file away, or start again with --overwrite",
    )


def _settings(job: BatchJob) -> dict[str, Any]:
    """Collect the settings that rows depend on, without engine, workers and threads."""
    options = asdict(job.options)
    del options["frame"]
    if job.known_lengths:
        options["lines_of"] = {
            name: [asdict(line) for line in lines] for name, lines in job.known_lengths.items()
        }
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
    """Make the job; load the model once to find its errors before the work."""
    named = tuple(classes) if classes else None
    path = resolve_model(None if detector is None else str(detector))
    model = checked_detector(Detector(path, classes=named, runtime=runtime), options)
    # its path may differ on other machines of a cluster
    bundled = model.path in bundled_models().values()
    name = model.path.stem if bundled else str(model.path.resolve())
    return BatchJob(
        name, networks_sha256(model.card), classes=named, options=options, runtime=runtime
    )


def _check(engine: str, address: str | None, workers: int | None, options: ScaleOptions) -> None:
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
    options.by_hand.check_single()


def _unfinished(output: Path, overwrite: bool) -> Path:
    """Check the path of a table: of a known format, and not yet complete."""
    table = check_table_path(output)
    if table.exists() and not journal_path(table).exists() and not overwrite:
        raise OutputError(
            f"{str(table)!r} exists and is complete: name another file, or pass --overwrite"
        )
    return table


def _rows(
    engine: str, job: BatchJob, tasks: Sequence[Task], workers: int | None, address: str | None
) -> Generator[BatchRow]:
    if not tasks:
        return
    if engine == "ray":
        yield from ray_rows(job, tasks, workers=workers, address=address)
    else:
        yield from local_rows(job, tasks, min(workers or local_workers(len(tasks)), len(tasks)))


def _write_counted(
    table: Path, rows: Iterable[BatchRow | None], *, details: bool
) -> tuple[dict[str, int], tuple[Cause, ...]]:
    """Write the table; return the number of rows by status, and the causes of those without a usable scale."""
    statuses: Counter[str] = Counter()
    causes: dict[tuple[str | None, str], Cause] = {}

    def counted() -> Iterator[Mapping[str, Any]]:
        for row in rows:
            assert row is not None  # the run is complete
            statuses["error" if row.estimate is None else row.estimate.status] += 1
            if (advice := row.advice) is not None:
                n_before, first = causes.get(same := (row.reason, advice.helps), (0, row))
                causes[same] = Cause(n_before + 1, first)
            yield row.flat()

    write_table(table, counted(), ALL_COLUMNS if details else COLUMNS)
    return dict(statuses), tuple(sorted(causes.values(), key=lambda cause: -cause.n_rows))
