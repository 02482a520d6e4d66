"""Table of a flight: the rows of ``vehanchor batch``, each with the scale of the flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.batch.row import BatchRow
from vehanchor.batch.table import write_table
from vehanchor_flight.project import estimate_in_flight

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_flight.records import FlightEstimate, FlightPhotograph


def write_flight_table(path: Path, record: FlightEstimate) -> None:
    """Write a row for each photograph.

    Args:
        path: as checked by ``vehanchor.batch.table.check_table_path``.
        record: of the flight.

    Raises:
        OutputError: the file cannot be written.
    """
    write_table(path, (_row(record, each) for each in record.photographs))


def _row(record: FlightEstimate, photograph: FlightPhotograph) -> BatchRow:
    if photograph.own is None:
        return BatchRow(file=photograph.photograph, error_code=photograph.error_code, error=photograph.error)
    return BatchRow(file=photograph.photograph, estimate=estimate_in_flight(record, photograph))
