"""The rows so far, on disk beside the table to be: what an interrupted run goes on from.

A journal is a file of JSON lines, ``<table>.journal``: first what the rows depend on, then a row a line in the order in
which they got ready. A last line that was cut off does not count.
"""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from vehanchor.batch.row import BatchRow
from vehanchor.errors import InvalidParameterError, OutputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path
    from types import TracebackType
    from typing import Self

__all__ = ["Journal", "journal_path"]


def journal_path(table: Path) -> Path:
    """Where the rows of a table are kept until it is complete."""
    return table.with_name(table.name + ".journal")


class Journal:
    """An open journal.

    Args:
        path: of its file; made if it is not there.
        basis: what the rows depend on, as JSON can hold it: rows of another basis must not be mixed in.

    Raises:
        InvalidParameterError: the file there has another basis, or is no journal.
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path, basis: Mapping[str, Any]) -> None:
        self.path = path
        self._offsets: dict[str, int] = {}
        try:
            self._file = path.open("a+b")
            try:
                end = self._read(dict(basis))
                self._file.truncate(end)
                if end == 0:
                    self._file.write(json.dumps(basis).encode() + b"\n")
                    self._file.flush()
            except BaseException:
                self._file.close()
                raise
        except OSError as error:
            raise OutputError(f"cannot keep rows in {str(path)!r}: {error.strerror or error}") from None

    def _read(self, basis: dict[str, Any]) -> int:
        """Find the rows; returns where the whole lines end."""
        self._file.seek(0)
        end = 0
        for number, line in enumerate(self._file):
            if not line.endswith(b"\n"):
                break
            try:
                record = json.loads(line)
                if number:
                    self._offsets[record["file"]] = end
            except (ValueError, TypeError, KeyError):
                raise InvalidParameterError(
                    f"{str(self.path)!r}, line {number + 1}, is no line of a journal: move the file away, or start "
                    "anew with --overwrite"
                ) from None
            if number == 0 and record != basis:
                raise InvalidParameterError(
                    f"{str(self.path)!r} holds rows of an unfinished run with {_difference(record, basis)}: finish "
                    "that run with its own options, or start anew with --overwrite"
                )
            end += len(line)
        return end

    def __contains__(self, file: str) -> bool:
        return file in self._offsets

    def add(self, row: BatchRow) -> None:
        """Keep a row; it is there after a crash of this process.

        Raises:
            OutputError: the disk refuses.
        """
        try:
            self._file.seek(0, os.SEEK_END)
            offset = self._file.tell()
            self._file.write(row.model_dump_json().encode() + b"\n")
            self._file.flush()
        except OSError as error:
            raise OutputError(f"cannot keep rows in {str(self.path)!r}: {error.strerror or error}") from None
        self._offsets[row.file] = offset

    def rows(self, files: Sequence[str]) -> Iterator[BatchRow]:
        """The rows of the files, in the files' order."""
        for file in files:
            self._file.seek(self._offsets[file])
            yield BatchRow.model_validate_json(self._file.readline())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _difference(theirs: Any, ours: Mapping[str, Any]) -> str:
    if not isinstance(theirs, dict):
        return "options that cannot be read"
    keys = sorted({*theirs, *ours})
    return ", ".join(
        f"{key} {theirs.get(key)!r} (now {ours.get(key)!r})" for key in keys if theirs.get(key) != ours.get(key)
    )
