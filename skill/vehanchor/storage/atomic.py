"""Atomic files: written completely or not at all."""

from __future__ import annotations

import hashlib
import os
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from pydantic import BaseModel


# Longest name, in bytes: file systems have 255, and SQLite appends "-journal".
_MAX_NAME_BYTES = 240
_NAME_DIGITS = 32


def check_output_path(
    path: str | os.PathLike[str],
    suffixes: Sequence[str] = (),
    *,
    kind: str = "a file",
    also: str = "",
) -> Path:
    """Check, before the work, that a file can be written to a path.

    Args:
        path: the path.
        suffixes: allowed suffixes; empty for any.
        kind: what the file holds, for messages.
        also: further advice for a wrong suffix.

    Raises:
        OutputError: the suffix is wrong, the folder does not exist, or the path is a folder.
    """
    target = Path(path)
    if suffixes and target.suffix.lower() not in suffixes:
        if len(suffixes) > 1:
            remedy = f"use one of {', '.join(suffixes)}"
        else:
            remedy = f"use the suffix {suffixes[0]}"
        if also:
            remedy += f"; {also}"
        raise OutputError(f"cannot write {kind} as {str(path)!r}: {remedy}")
    if not target.parent.is_dir():
        raise OutputError(
            f"cannot write {str(path)!r}: there is no folder {str(target.parent)!r}; create it "
            "first"
        )
    if target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: it is a folder; name a file")
    return target


def beside(path: Path, suffix: str) -> Path:
    """Name a file beside another one, such as ``NAME.journal``.

    A name that would be too long for file systems is shortened, always in the same way.
    """
    name = path.name + suffix
    if len(os.fsencode(name)) > _MAX_NAME_BYTES:
        digest = hashlib.sha256(os.fsencode(path.name)).hexdigest()
        name = f"{digest[:_NAME_DIGITS]}{suffix}"
    return path.with_name(name)


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a temporary file, which replaces the target once it is complete and on the disk.

    Yields:
        The path to write to, beside the target. If the block raises, the target does not change.

    Raises:
        OutputError: the file cannot be written.
    """
    temporary = beside(path, f".{os.getpid()}.partial")
    partial = temporary.with_name(f".{temporary.name}")
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


def write_record(path: Path, record: BaseModel, *, indent: int = 1) -> None:
    """Write a record as JSON.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as partial:
        text = record.model_dump_json(indent=indent)
        partial.write_text(f"{text}\n", encoding="utf-8")


def _sync_folder(path: Path) -> None:
    """Flush the new name to the disk, if the system can sync a folder."""
    with suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
