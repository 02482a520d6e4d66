"""Files of the records of flights and reconstructions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.records import FlightEstimate

if TYPE_CHECKING:
    import os

    from vehanchor_flight.records import ModelScale

_MAX_BYTES = 1 << 30


def check_record_path(path: Path) -> Path:
    """Check, before the work, that a record can be written to a path.

    Raises:
        OutputError: the suffix is not .json, the folder does not exist, or the path is a folder.
    """
    if path.suffix.lower() != ".json":
        raise OutputError(f"cannot write a record as {str(path)!r}: use the suffix .json")
    if not path.parent.is_dir():
        raise OutputError(f"there is no folder {str(path.parent)!r} for {path.name!r}: create it first")
    if path.is_dir():
        raise OutputError(f"{str(path)!r} is a folder: name a file")
    return path


def write_record(path: Path, record: FlightEstimate | ModelScale) -> None:
    """Write a record as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as partial:
        partial.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_record(path: str | os.PathLike[str]) -> FlightEstimate:
    """Read a file of ``vehanchor flight --out``.

    Raises:
        InvalidParameterError: the file does not exist, or is not the record of a flight.
    """
    file = Path(path)
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise InvalidParameterError(f"{str(path)!r} is too large for the record of a flight")
        return FlightEstimate.model_validate_json(file.read_bytes())
    except OSError as error:
        raise InvalidParameterError(f"cannot read the flight {str(path)!r}: {error.strerror or error}") from None
    except ValidationError:
        raise InvalidParameterError(
            f"{str(path)!r} is not a flight record of this version: make one with 'vehanchor flight --out'"
        ) from None
