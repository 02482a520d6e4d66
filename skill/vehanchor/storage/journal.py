"""Journal of a long run: results on disk, from which an interrupted run resumes.

A journal is an SQLite file with one table: a row is the result of one source under one set of
settings. Settings are what results depend on besides their source (version, model, options); a row
has their hash, and the row with the empty key has the settings themselves. A key has the state of
the source when the work began (``Source``), so that results of a replaced file are not found. Each
result is committed alone: a killed run loses none. The file is never opened through a link.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import threading
import weakref
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Self, TypeAlias, TypeVar

from pydantic_core import to_jsonable_python

from vehanchor.errors import InvalidParameterError, OutputError

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator, Mapping

Key: TypeAlias = tuple[str | int, ...]
Value = TypeVar("Value")
_UNREADABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
# marks our files; another for another table. Other programs' databases are left alone
_APPLICATION_ID = 0x56416A6C
_TABLE = (
    "CREATE TABLE IF NOT EXISTS results (settings TEXT, key TEXT, value TEXT NOT NULL, PRIMARY KEY "
    "(settings, key)) WITHOUT ROWID"
)
_WAIT_S = 30.0  # for another process that writes to a shared file
_FACTS = ""  # the key of the settings


class Source(NamedTuple):
    """The state of a file: its key in a journal changes if the file is replaced.

    Attributes:
        path: absolute, links followed.
        size: bytes; -1 where there is no such file.
        mtime_ns: time of its last change.
    """

    path: str
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, file: str | os.PathLike[str]) -> Source:
        """Read the state of the file of that name."""
        path = Path(file).resolve()
        try:
            facts = path.stat()
        except OSError:
            return cls(str(path), -1, 0)
        return cls(str(path), facts.st_size, facts.st_mtime_ns)


class Journal(Generic[Value]):
    """Results by key; safe for several threads and, unless ``sole``, for several processes.

    Args:
        path: path of the file, created with its folder; None keeps results in memory only.
        settings: JSON values or records that all results depend on; results of other settings are
            ignored.
        dump: converts a result to JSON values.
        load: converts JSON values to a result.
        sole: refuse a file with results of other settings, and lock the file against other runs
            until ``close``.
        anew: discard earlier results.
        remedy: advice to the user for an unusable file.

    Raises:
        InvalidParameterError: the file is not a journal; with ``sole``, it has other settings.
        OutputError: the file cannot be read or written, is a link, or belongs to a run that has not
            ended.
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
        self._facts: dict[str, Any] = to_jsonable_python(settings)
        self._settings = hashlib.sha256(
            json.dumps(self._facts, sort_keys=True).encode()
        ).hexdigest()
        self._dump = dump
        self._load = load
        self._remedy = remedy
        self._lock = threading.Lock()
        with self._errors_told():
            try:
                self._file = self._open(sole=sole, anew=anew)
            except sqlite3.DatabaseError as error:
                if (
                    not anew
                    or path is None
                    or getattr(error, "sqlite_errorcode", None) != sqlite3.SQLITE_NOTADB
                ):
                    raise
                path.unlink()
                self._file = self._open(sole=sole, anew=anew)
        weakref.finalize(self, self._file.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let other runs use the file."""
        self._file.close()

    def _open(self, *, sole: bool, anew: bool) -> sqlite3.Connection:
        if self.path is not None:
            if self.path.is_symlink():
                raise OutputError(
                    f"{str(self.path)!r} is a link: remove it, or name another output"
                )
            self.path.parent.mkdir(parents=True, exist_ok=True)
        wait_s = 0.0 if sole else _WAIT_S
        file = sqlite3.connect(
            self.path or ":memory:", wait_s, isolation_level=None, check_same_thread=False
        )
        try:
            file.execute("PRAGMA synchronous = NORMAL")
            if sole:
                # the lock of the next transaction stays
                file.execute("PRAGMA locking_mode = EXCLUSIVE")
            file.execute("BEGIN EXCLUSIVE")
            self._begin(file, sole=sole, anew=anew)
            file.execute("COMMIT")
        except BaseException:
            file.close()
            raise
        return file

    def _begin(self, file: sqlite3.Connection, *, sole: bool, anew: bool) -> None:
        """Prepare the table; check that the file is ours, and its settings."""
        ((mark,),) = file.execute("PRAGMA application_id")
        ((n_tables,),) = file.execute("SELECT count(*) FROM sqlite_master")
        if n_tables and mark != _APPLICATION_ID:
            raise sqlite3.DatabaseError("it belongs to another program")
        file.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        file.execute(_TABLE)
        if anew:
            file.execute("DELETE FROM results")
        others = file.execute(
            "SELECT value FROM results WHERE key = ? AND settings IN (SELECT settings FROM results "
            "WHERE key <> ? AND settings <> ?)",
            (_FACTS, _FACTS, self._settings),
        ).fetchone()
        if sole and others is not None:
            other = _difference(json.loads(others[0]), self._facts)
            raise InvalidParameterError(
                f"{str(self.path)!r} has results of an unfinished run with {other}: finish that "
                f"run with its options, or {self._remedy}"
            )
        row = (self._settings, _FACTS, json.dumps(self._facts))
        file.execute("INSERT OR IGNORE INTO results VALUES (?, ?, ?)", row)

    @contextmanager
    def _errors_told(self) -> Iterator[None]:
        """Convert errors of SQLite and of the system."""
        try:
            yield
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
                raise OutputError(
                    f"another run is using {str(self.path)!r}: wait until it has ended, or name "
                    "another output"
                ) from None
            raise OutputError(f"cannot keep results in {str(self.path)!r}: {error}") from None
        except OSError as error:
            raise OutputError(
                f"cannot keep results in {str(self.path)!r}: {error.strerror or error}"
            ) from None
        except sqlite3.DatabaseError as error:
            raise InvalidParameterError(
                f"{str(self.path)!r} is not a journal, or is damaged ({error}): {self._remedy}"
            ) from None

    def _found(self, query: str, *values: str) -> Any:
        """Get the first column of the first row; None without a row."""
        with self._lock, self._errors_told():
            row = self._file.execute(f"SELECT {query}", (self._settings, *values)).fetchone()
        return None if row is None else row[0]

    def __contains__(self, key: Key) -> bool:
        return (
            self._found("1 FROM results WHERE settings = ? AND key = ?", json.dumps(key))
            is not None
        )

    def __len__(self) -> int:
        n_results: int = self._found(
            "count(*) FROM results WHERE settings = ? AND key <> ?", _FACTS
        )
        return n_results

    def add(self, key: Key, value: Value) -> None:
        """Add a result; it survives a crash of this process.

        Raises:
            OutputError: the file cannot be written.
        """
        row = (self._settings, json.dumps(key), json.dumps(self._dump(value), allow_nan=False))
        with self._lock, self._errors_told():
            self._file.execute("INSERT OR REPLACE INTO results VALUES (?, ?, ?)", row)

    def get(self, key: Key) -> Value | None:
        """Get the result of a key; None if it is unknown.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: the result is damaged, or has another version.
        """
        found = self._found("value FROM results WHERE settings = ? AND key = ?", json.dumps(key))
        try:
            return None if found is None else self._load(json.loads(found))
        except _UNREADABLE as error:
            raise InvalidParameterError(
                f"{str(self.path)!r} has an unreadable result of {key} ({error}): {self._remedy}"
            ) from None

    def remove(self) -> None:
        """Delete the file: the run is complete."""
        self.close()
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _difference(theirs: Any, ours: Mapping[str, Any]) -> str:
    before = dict(_leaves("", theirs))
    now = dict(_leaves("", ours))
    keys = sorted({*before, *now})
    return ", ".join(
        f"{key} {before.get(key)!r} (now {now.get(key)!r})"
        for key in keys
        if before.get(key) != now.get(key)
    )


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, dict):
        yield name, value
        return
    for key, inner in value.items():
        yield from _leaves(f"{name}.{key}" if name else key, inner)
