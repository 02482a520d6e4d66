"""Files of the records of flights and reconstructions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import OutputError
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_flight.records import FlightEstimate, ModelScale


def check_output(path: Path, suffix: str = "") -> Path:
    """Check, before the work, that a file can be written to a path.

    Args:
        path: the path.
        suffix: that it must have, such as ".json"; empty for any.

    Raises:
        OutputError: it has another suffix, its folder does not exist, or it is a folder.
    """
    if suffix and path.suffix.lower() != suffix:
        raise OutputError(f"cannot write {str(path)!r}: use the suffix {suffix}")
    if not path.parent.is_dir() or path.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    return path


def write_record(path: Path, record: FlightEstimate | ModelScale) -> None:
    """Write a record as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as partial:
        partial.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")
