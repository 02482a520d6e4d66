"""A flight's record as a file, and the scale of one photograph from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ValidationError

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.records import FlightEstimate
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    import os

    from vehanchor.records import FlightPhotograph

_MAX_BYTES = 1 << 30


def check_record_path(path: Path) -> Path:
    """Make sure, before the work, that a record can be written there.

    Raises:
        OutputError: another suffix than .json, no such folder, or a folder of that name.
    """
    if path.suffix.lower() != ".json":
        raise OutputError(f"cannot write a flight as {str(path)!r}: use the suffix .json")
    if not path.parent.is_dir():
        raise OutputError(f"there is no folder {str(path.parent)!r} to write {path.name!r} into: make it first")
    if path.is_dir():
        raise OutputError(f"{str(path)!r} is a folder: name a file")
    return path


def write_record(path: Path, record: FlightEstimate) -> None:
    """Write a flight's record.

    Raises:
        OutputError: the disk refuses.
    """
    with whole_file(path) as partial:
        partial.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")


def read_record(path: str | os.PathLike[str]) -> FlightEstimate:
    """Read what ``vehanchor flight --out`` wrote.

    Raises:
        InvalidParameterError: there is no such file, or it is no flight's record.
    """
    file = Path(path)
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise InvalidParameterError(f"{str(path)!r} is too large for a flight's record")
        return FlightEstimate.model_validate_json(file.read_bytes())
    except OSError as error:
        raise InvalidParameterError(f"cannot read the flight {str(path)!r}: {error.strerror or error}") from None
    except ValidationError:
        raise InvalidParameterError(
            f"{str(path)!r} is no record of a flight of this version: make one with 'vehanchor flight --out'"
        ) from None


def photograph_in(record: FlightEstimate, image: str | os.PathLike[str]) -> FlightPhotograph:
    """Find a photograph in a flight's record: by the file, else by its name where only one is called so.

    Raises:
        InvalidParameterError: it is not there, or has no scale.
    """
    wanted = Path(image)
    same = [each for each in record.photographs if Path(each.photograph).absolute() == wanted.absolute()]
    named = same or [each for each in record.photographs if Path(each.photograph).name == wanted.name]
    if len(named) != 1:
        found = "not there" if not named else f"there {len(named)} times"
        raise InvalidParameterError(f"{str(image)!r} is {found} in the flight: name a photograph of it by its path")
    if named[0].scale is None:
        raise InvalidParameterError(f"the flight has no scale for {str(image)!r} ({named[0].status}): give --gsd")
    return named[0]
