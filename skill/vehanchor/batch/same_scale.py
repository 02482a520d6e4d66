"""Batch of images with one common scale: the table of ``vehanchor.batch`` with that scale in every row."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.batch.row import BatchRow
from vehanchor.batch.run import BatchSummary, journal_path, write_counted
from vehanchor.batch.table import check_table_path
from vehanchor.errors import OutputError
from vehanchor.flight.estimate import check_options, conclude, journal_key, open_journal, search_flight
from vehanchor.flight.inputs import named
from vehanchor.flight.project import estimate_in_flight
from vehanchor.imagery.sources.files import find_images
from vehanchor.rulers.known_length_table import lines_in

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.options import ScaleOptions
    from vehanchor.records import FlightEstimate, FlightPhotograph


def run_same_scale(
    inputs: Sequence[str],
    output: str | os.PathLike[str],
    *,
    detector: Detector,
    options: ScaleOptions,
    known_lengths: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> BatchSummary:
    """Estimate the common scale of many images, and write a table with a row for each.

    Results are kept in ``<output>.journal`` until the table is complete, as by ``run_batch``.

    Args:
        inputs: directories, patterns and files.
        output: ``.parquet``, ``.csv`` or ``.jsonl``.
        detector: finds the vehicles; images are reported to the progress of its runtime.
        options: all options of the method, without a frame.
        known_lengths: CSV with lines of known length by image; see ``read_known_lengths``.
        overwrite: start again; an existing table is replaced when the new one is complete.

    Raises:
        VehAnchorError: as ``run_batch`` and ``Engine.flight``.
    """
    table = check_table_path(Path(output))
    journal = journal_path(table)
    if table.exists() and not journal.exists() and not overwrite:
        raise OutputError(f"{str(table)!r} exists and is complete: name another file, or pass --overwrite")
    images = find_images(inputs, leave_out=(table, journal))
    lines = lines_in(known_lengths, images)
    check_options(options)
    photographs = list(named(images))
    with open_journal(journal, detector, options, lines, anew=overwrite) as kept:
        n_resumed = sum((key := journal_key(each)) is not None and key in kept for each in photographs)
        results = search_flight(photographs, detector, options, journal=kept, lines=lines)
        record = conclude(results, detector.card, same_scale=True)
        statuses, reasons = write_counted(table, (_row(record, each) for each in record.photographs))
        kept.remove()
    return BatchSummary(table, len(images), n_resumed, statuses, reasons)


def _row(flight: FlightEstimate, photograph: FlightPhotograph) -> BatchRow:
    """Make the row of a photograph with the common scale."""
    if photograph.own is None:
        return BatchRow(file=photograph.photograph, error_code=photograph.error_code, error=photograph.error)
    return BatchRow(file=photograph.photograph, estimate=estimate_in_flight(flight, photograph))
