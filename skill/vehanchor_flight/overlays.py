"""Pictures of a flight: each photograph with its vehicles and its scale in the flight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.pictures.overlays import Overlays
from vehanchor_flight.photograph import Photograph
from vehanchor_flight.project import estimate_in_flight

if TYPE_CHECKING:
    import os

    from vehanchor.options import Reading
    from vehanchor_flight.record import Results
    from vehanchor_flight.records import FlightEstimate


def write_overlays(
    folder: str | os.PathLike[str], results: Results, record: FlightEstimate, reading: Reading
) -> None:
    """Draw the usable photographs of a flight; the files are read again.

    Args:
        folder: folder of the pictures; made if missing.
        results: the searched photographs.
        record: of the flight, with the photographs in the same order.
        reading: how the photographs are read.

    Raises:
        OutputError: a picture cannot be written.
        ImageError: a photograph can no longer be read.
    """
    drawn = []
    for result, photograph in zip(results, record.photographs, strict=True):
        if isinstance(result, Photograph):
            drawn.append((str(Path(result.name).absolute()), result, photograph))
    overlays = Overlays.of(folder, [path for path, _, _ in drawn])
    for path, result, photograph in drawn:
        estimate = estimate_in_flight(record, photograph)
        analysis = replace(result.analysis, estimate=estimate, reading=reading)
        overlays.write(path, analysis.overlay(path))
