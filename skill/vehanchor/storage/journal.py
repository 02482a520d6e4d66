"""Results of a long run, on disk as they come: an interrupted run goes on from there instead of starting anew.

A journal is a file of JSON lines that is only ever appended to. A line of settings says once what results depend on
besides their source (version, model, options); each result follows as ``{"settings": ..., "key": ..., "value": ...}``,
so that several settings may share a file. A last line that was cut off by a crash is dropped. A key tells the source
as it was when the work began (``vehanchor.imagery.identity.Source``): a result of a replaced file is not found.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import threading
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

from pydantic import BaseModel

from vehanchor.errors import InvalidParameterError, OutputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from typing import IO

Key: TypeAlias = tuple[str | int, ...]
Value = TypeVar("Value")
_START = b'{"settings": '
_VERSION = 2
"""Of the lines; journals of another version are refused, or not seen, as those of other settings are."""


class Journal(Generic[Value]):
    """Results by key; safe for several threads.

    Args:
        path: of the file, made with its folder; None keeps results in memory only.
        settings: what all results depend on, as JSON can hold it (records too); those of others are not seen.
        dump: a result as JSON can hold it.
        load: the same back.
        sole: refuse a file that holds results of other settings, instead of sharing it with them.
        remedy: what the user can do about a file that cannot be used.

    Raises:
        InvalidParameterError: the file is no journal; or, with ``sole``, it is one of other settings.
        OutputError: the file cannot be read or written.
    """

    def __init__(
        self,
        path: Path | None,
        settings: Mapping[str, Any],
        *,
        dump: Callable[[Value], Any],
        load: Callable[[Any], Value],
        sole: bool = False,
        remedy: str = "move the file away",
    ) -> None:
        self.path = path
        self._facts: dict[str, Any] = json.loads(json.dumps({"journal_version": _VERSION, **settings}, default=_plain))
        self._settings = hashlib.sha256(json.dumps(self._facts, sort_keys=True).encode()).hexdigest()[:16]
        self._dump, self._load, self._sole, self._remedy = dump, load, sole, remedy
        self._offsets: dict[Key, int] = {}
        self._declared = False  # whether the file says what our settings are
        self._memory = io.BytesIO()
        self._lock = threading.Lock()
        if path is not None:
            self._read(path)

    def _read(self, path: Path) -> None:
        """Find the results of these settings; drop a last line that was cut off."""
        with self._opened("a+b") as file:
            file.seek(0)
            end = 0
            for number, line in enumerate(file, start=1):
                if not line.endswith(b"\n") and (line.startswith(_START) or _START.startswith(line)):
                    file.truncate(end)
                    break
                try:
                    self._take(json.loads(line), end)
                except (ValueError, TypeError, KeyError):
                    raise InvalidParameterError(
                        f"{str(path)!r}, line {number}, is no line of a journal: {self._remedy}"
                    ) from None
                except _OtherSettingsError as other:
                    raise InvalidParameterError(
                        f"{str(path)!r} holds rows of an unfinished run with {other}: finish that run with its own "
                        f"options, or {self._remedy}"
                    ) from None
                end += len(line)

    def _take(self, record: dict[str, Any], offset: int) -> None:
        ours = record["settings"] == self._settings
        if "facts" not in record:
            key = tuple(record["key"])
            if ours:
                self._offsets[key] = offset
        elif ours:
            self._declared = True
        elif self._sole:
            raise _OtherSettingsError(_difference(record["facts"], self._facts))

    @contextmanager
    def _opened(self, mode: str) -> Iterator[IO[bytes]]:
        if self.path is None:
            yield self._memory
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open(mode, buffering=0 if mode == "ab" else -1) as file:  # a line is written at once
                yield file
        except OSError as error:
            raise OutputError(f"cannot keep results in {str(self.path)!r}: {error.strerror or error}") from None

    def __contains__(self, key: Key | None) -> bool:
        return key in self._offsets

    def __len__(self) -> int:
        return len(self._offsets)

    def add(self, key: Key, value: Value) -> None:
        """Keep a result; it is there after a crash of this process.

        Raises:
            OutputError: the disk refuses.
        """
        record = {"settings": self._settings, "key": key, "value": self._dump(value)}
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        with self._lock, self._opened("ab") as file:
            first = b"" if self._declared else self._declaration()
            start = file.seek(0, os.SEEK_END)
            if file.write(first + line) != len(first + line):
                with suppress(OSError):
                    file.truncate(start)  # the next line must not be appended to half of this one
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._offsets[key] = file.tell() - len(line)  # another process may append, too
            self._declared = True

    def _declaration(self) -> bytes:
        return json.dumps({"settings": self._settings, "facts": self._facts}).encode() + b"\n"

    def get(self, key: Key) -> Value | None:
        """The result of a key, if it is known.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: a result in it is none of this version.
        """
        return next(self.values([key])) if key in self._offsets else None

    def values(self, keys: Iterable[Key]) -> Iterator[Value]:
        """The results of known keys, in the keys' order, read one at a time.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: a result in it is none of this version.
        """
        for key in keys:
            with self._lock, self._opened("rb") as file:
                file.seek(self._offsets[key])
                line = file.readline()
            try:
                yield self._load(json.loads(line)["value"])
            except (ValueError, TypeError, KeyError) as error:
                raise InvalidParameterError(
                    f"{str(self.path)!r} holds a result of {key} that cannot be read ({error}): {self._remedy}"
                ) from None

    def remove(self) -> None:
        """Delete the file: the run is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


class _OtherSettingsError(Exception):
    """The settings of a journal differ; the message says in what."""


def _plain(record: Any) -> Any:
    if isinstance(record, BaseModel):
        return record.model_dump(mode="json")
    raise TypeError(f"{type(record).__name__} is no JSON")


def _difference(theirs: Any, ours: Mapping[str, Any]) -> str:
    before, now = dict(_leaves("", theirs)), dict(_leaves("", ours))
    keys = sorted({*before, *now})
    return ", ".join(
        f"{key} {before.get(key)!r} (now {now.get(key)!r})" for key in keys if before.get(key) != now.get(key)
    )


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield name, value
        return
    for key, inner in value.items():
        yield from _leaves(f"{name}.{key}" if name else key, inner)
