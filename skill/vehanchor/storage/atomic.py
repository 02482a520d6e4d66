"""Files that are written whole or not at all, whatever happens at whatever byte, and never over what is read."""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator


def check_apart(path: Path, image: str) -> None:
    """Make sure that what is to be written does not take the image's place.

    Raises:
        InvalidParameterError: both are one file.
    """
    if path.resolve() == Path(image).resolve():
        raise InvalidParameterError(f"{str(path)!r} is the image itself: choose another name")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file beside the one wanted, to be written in its stead; it takes its place once it is whole and on the disk.

    Yields:
        The path to write to. If the block raises, what was at ``path`` stays.

    Raises:
        OutputError: the disk refuses.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(path)
        _sync_folder(path)
    except OSError as error:
        raise OutputError(f"cannot write {str(path)!r}: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _sync_folder(path: Path) -> None:
    """Have the new name on the disk, too, where a folder can be asked for that."""
    with suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
