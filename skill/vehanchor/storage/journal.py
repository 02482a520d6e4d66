"""Journal of a long run: results on disk, from which an interrupted run resumes.

A journal is an append-only file of JSON lines. A line of settings states what results depend on besides their source
(version, model, options). Each result is a line ``{"settings": ..., "key": ..., "value": ..., "sum": ...}``, so that
several settings can share a file; the sum of the value tells a damaged line. A last line cut off by a crash is
dropped. The file is never opened through a link. A key has the state of the source when the work
began (``vehanchor.imagery.identity.Source``), so that results of a replaced file are not found.
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
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias, TypeVar

from pydantic import BaseModel

from vehanchor.errors import InvalidParameterError, OutputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from typing import IO

Key: TypeAlias = tuple[str | int, ...]
Value = TypeVar("Value")
_START = b'{"settings": '
_UNREADABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
_VERSION = 3
"""Version of the lines; another version counts as other settings."""


class Journal(Generic[Value]):
    """Results by key; safe for several threads.

    Args:
        path: path of the file, created with its folder; None keeps results in memory only.
        settings: JSON values or records that all results depend on; results of other settings are ignored.
        dump: converts a result to JSON values.
        load: converts JSON values to a result.
        sole: refuse a file with results of other settings, and lock the file against other runs until ``close``
            (not on Windows).
        anew: discard earlier results.
        remedy: advice to the user for an unusable file.

    Raises:
        InvalidParameterError: the file is not a journal; with ``sole``, it has other settings.
        OutputError: the file cannot be read or written, is a link, or belongs to a run that has not ended.
    """

    def __init__(
        self,
        path: Path | None,
        settings: Mapping[str, Any],
        *,
        dump: Callable[[Value], Any],
        load: Callable[[Any], Value],
        sole: bool = False,
        anew: bool = False,
        remedy: str = "move the file away",
    ) -> None:
        self.path = path
        self._facts: dict[str, Any] = json.loads(json.dumps({"journal_version": _VERSION, **settings}, default=_plain))
        self._settings = hashlib.sha256(json.dumps(self._facts, sort_keys=True).encode()).hexdigest()[:16]
        self._dump, self._load, self._sole, self._remedy = dump, load, sole, remedy
        self._offsets: dict[Key, int] = {}
        self._declared = False  # whether the file has the line of our settings
        self._memory = io.BytesIO()
        self._lock = threading.Lock()
        self._held: IO[bytes] | None = None
        if path is not None:
            try:
                if sole:
                    self._hold(path)
                if anew:
                    self._start_again()
                self._read(path)
            except BaseException:
                self.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let other runs use the file."""
        if self._held is not None:
            self._held.close()
            self._held = None

    def _hold(self, path: Path) -> None:
        """Lock the file until it closes.

        Raises:
            OutputError: another run holds it.
        """
        try:
            import fcntl
        except ImportError:  # Windows
            return
        while True:
            with self._opened("ab") as file:
                held = os.fdopen(os.dup(file.fileno()), "rb")
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                held.close()
                if error.errno not in (errno.EAGAIN, errno.EACCES):
                    return  # a file system without locks
                raise OutputError(
                    f"another run is using {str(path)!r}: wait until it has ended, or name another output"
                ) from None
            with suppress(OSError):
                if os.path.samestat(os.fstat(held.fileno()), os.lstat(path)):
                    self._held = held
                    return
            held.close()  # another run has just ended and removed the file

    def _start_again(self) -> None:
        with self._opened("ab") as file:
            file.truncate(0)

    def _read(self, path: Path) -> None:
        """Index the results of these settings; drop an incomplete last line."""
        with self._opened("a+b") as file:
            file.seek(0)
            end = 0
            for number, line in enumerate(file, start=1):
                if not line.endswith(b"\n") and (line.startswith(_START) or _START.startswith(line)):
                    file.truncate(end)
                    break
                try:
                    self._take(json.loads(line), end)
                except _UNREADABLE:
                    raise InvalidParameterError(
                        f"{str(path)!r}, line {number}, is not a line of a journal, or is damaged: {self._remedy}"
                    ) from None
                except _OtherSettingsError as other:
                    raise InvalidParameterError(
                        f"{str(path)!r} has results of an unfinished run with {other}: finish that run with its "
                        f"options, or {self._remedy}"
                    ) from None
                end += len(line)

    def _take(self, record: dict[str, Any], offset: int) -> None:
        ours = record["settings"] == self._settings
        if "facts" not in record:
            key = tuple(record["key"])
            if ours:
                if record["sum"] != _sum(record["value"]):
                    raise ValueError
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
            buffering = 0 if mode == "ab" else -1  # lines at once
            with open(self.path, mode, buffering, opener=_open_no_link) as file:
                yield file
        except OSError as error:
            if error.errno == errno.ELOOP:
                raise OutputError(f"{str(self.path)!r} is a link: remove it, or name another output") from None
            raise OutputError(f"cannot keep results in {str(self.path)!r}: {error.strerror or error}") from None

    def __contains__(self, key: Key | None) -> bool:
        return key in self._offsets

    def __len__(self) -> int:
        return len(self._offsets)

    def add(self, key: Key, value: Value) -> None:
        """Add a result; it survives a crash of this process.

        Raises:
            OutputError: the file cannot be written.
        """
        dumped = self._dump(value)
        record = {"settings": self._settings, "key": key, "value": dumped, "sum": _sum(dumped)}
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        with self._lock, self._opened("ab") as file:
            first = b"" if self._declared else self._declaration()
            start = file.seek(0, os.SEEK_END)
            if file.write(first + line) != len(first + line):
                with suppress(OSError):
                    file.truncate(start)  # or the next line would follow an incomplete one
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self._offsets[key] = file.tell() - len(line)  # another process may append, too
            self._declared = True

    def _declaration(self) -> bytes:
        return json.dumps({"settings": self._settings, "facts": self._facts}).encode() + b"\n"

    def get(self, key: Key) -> Value | None:
        """Get the result of a key; None if it is unknown.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: a result has another version.
        """
        return next(self.values([key])) if key in self._offsets else None

    def values(self, keys: Iterable[Key]) -> Iterator[Value]:
        """Read the results of known keys one by one, in the order of the keys.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: a result has another version.
        """
        for key in keys:
            with self._lock, self._opened("rb") as file:
                file.seek(self._offsets[key])
                line = file.readline()
            try:
                yield self._load(json.loads(line)["value"])
            except _UNREADABLE as error:
                raise InvalidParameterError(
                    f"{str(self.path)!r} has an unreadable result of {key} ({error}): {self._remedy}"
                ) from None

    def remove(self) -> None:
        """Delete the file: the run is complete."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
        self.close()


def _open_no_link(name: str, flags: int) -> int:
    return os.open(name, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


def _sum(value: Any) -> str:
    """Hash a JSON value; floats, texts and the order of keys survive a file."""
    return hashlib.sha256(json.dumps(value, allow_nan=False).encode()).hexdigest()[:16]


class _OtherSettingsError(Exception):
    """Difference in the settings of a journal; the message names it."""


def _plain(record: Any) -> Any:
    if isinstance(record, BaseModel):
        return record.model_dump(mode="json")
    raise TypeError(f"{type(record).__name__} is not JSON")


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
