"""Journal of a long run: results on disk, from which an interrupted run resumes.

A journal is an SQLite file with one table. Each row is the result of one source under one set of
settings. Settings are what results depend on besides their source: version, model, options. Each
row has the hash of its settings; a row with an empty key has the settings themselves. A key
contains the state of the source when the work began (``Source``), so that results of a replaced
file are not found. Each result is committed alone, so that a killed run loses none. The file is
never opened through a link.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import threading
import weakref
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Self, TypeAlias, TypeVar

from pydantic_core import to_jsonable_python

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.storage.exclusive import ExclusiveFile, has_locks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

Key: TypeAlias = tuple[str | int, ...]
Value = TypeVar("Value")
# A damaged value can cause any of these.
_UNREADABLE = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
# The header of each journal has this number, so that databases of other programs are left alone.
# A change of the table needs another number.
_APPLICATION_ID = 0x56416A6C
_CREATE_TABLE = (
    "CREATE TABLE IF NOT EXISTS results "
    "(settings TEXT, key TEXT, value TEXT NOT NULL, PRIMARY KEY (settings, key)) WITHOUT ROWID"
)
_SELECT_OTHER_SETTINGS = (
    "SELECT value FROM results WHERE key = ? AND settings IN "
    "(SELECT settings FROM results WHERE key <> ? AND settings <> ?)"
)
_WAIT_S = 30.0  # for another process that writes to a shared file
_SETTINGS_KEY = ""


class Source(NamedTuple):
    """State of a file, as a part of a key that changes if the file is replaced.

    Attributes:
        path: absolute path without links.
        size: size in bytes; -1 for a missing file.
        mtime_ns: time of the last change, nanoseconds.
    """

    path: str
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, file: str | os.PathLike[str]) -> Source:
        """Read the state of a file."""
        # Path.resolve raises an error for a link to itself.
        path = Path(os.path.realpath(file))
        try:
            state = path.stat()
        except OSError:
            return cls(str(path), -1, 0)
        return cls(str(path), state.st_size, state.st_mtime_ns)


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
        remedy: advice to the user about an unusable file.

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
        self._settings: dict[str, Any] = to_jsonable_python(settings)
        settings_text = json.dumps(self._settings, sort_keys=True)
        self._settings_sha256 = hashlib.sha256(settings_text.encode()).hexdigest()
        self._dump = dump
        self._load = load
        self._remedy = remedy
        self._lock = threading.Lock()
        self._exclusive: ExclusiveFile | None = None
        with self._errors_converted():
            try:
                self._database = self._open(sole=sole, anew=anew)
            except sqlite3.DatabaseError as error:
                # To start anew, a file that is not a database may go; a foreign database may not.
                error_code = getattr(error, "sqlite_errorcode", None)
                if not anew or path is None or error_code != sqlite3.SQLITE_NOTADB:
                    raise
                path.unlink()
                self._database = self._open(sole=sole, anew=anew)
        weakref.finalize(self, self._database.close)
        if self._exclusive is not None:
            weakref.finalize(self, self._exclusive.release)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file, so that other runs can use it."""
        self._database.close()
        if self._exclusive is not None:
            self._exclusive.release()
            self._exclusive = None

    def _open(self, *, sole: bool, anew: bool) -> sqlite3.Connection:
        """Open the file; on a mount without locks, with a file that stands for them."""
        try:
            return self._connect(sole=sole, anew=anew)
        except sqlite3.OperationalError:
            if self.path is None or has_locks(self.path.parent):
                raise
        self._exclusive = ExclusiveFile(self.path)
        try:
            return self._connect(sole=sole, anew=anew)
        except BaseException:
            self._exclusive.release()
            raise

    def _connect(self, *, sole: bool, anew: bool) -> sqlite3.Connection:
        if self.path is not None:
            if self.path.is_symlink():
                raise OutputError(
                    f"{str(self.path)!r} is a link: remove it, or name another output"
                )
            self.path.parent.mkdir(parents=True, exist_ok=True)
        timeout_s = 0.0 if sole else _WAIT_S
        # Without an isolation level, a statement outside a transaction commits at once.
        address = "file::memory:"
        if self.path is not None:
            address = self.path.absolute().as_uri()
            if self._exclusive is not None:
                address += "?nolock=1"
        database = sqlite3.connect(
            address, timeout_s, isolation_level=None, check_same_thread=False, uri=True
        )
        try:
            database.execute("PRAGMA synchronous = NORMAL")
            if sole:
                # The lock of the next transaction then stays until the file is closed.
                database.execute("PRAGMA locking_mode = EXCLUSIVE")
            database.execute("BEGIN EXCLUSIVE")
            self._prepare(database, sole=sole, anew=anew)
            database.execute("COMMIT")
        except BaseException:
            database.close()
            raise
        return database

    def _prepare(self, database: sqlite3.Connection, *, sole: bool, anew: bool) -> None:
        """Check that the database is a journal, create its table, check the settings, add ours."""
        ((application_id,),) = database.execute("PRAGMA application_id")
        ((n_tables,),) = database.execute("SELECT count(*) FROM sqlite_master")
        if n_tables and application_id != _APPLICATION_ID:
            raise sqlite3.DatabaseError("it belongs to another program")
        database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
        database.execute(_CREATE_TABLE)
        if anew:
            database.execute("DELETE FROM results")
        keys = (_SETTINGS_KEY, _SETTINGS_KEY, self._settings_sha256)
        other_settings = database.execute(_SELECT_OTHER_SETTINGS, keys).fetchone()
        if sole and other_settings is not None:
            earlier = json.loads(other_settings[0])
            difference = _difference(earlier, self._settings)
            raise InvalidParameterError(
                f"{str(self.path)!r} has results of an unfinished run with {difference}: finish "
                f"that run with its options, or {self._remedy}"
            )
        settings_text = json.dumps(self._settings)
        row = (self._settings_sha256, _SETTINGS_KEY, settings_text)
        database.execute("INSERT OR IGNORE INTO results VALUES (?, ?, ?)", row)

    @contextmanager
    def _errors_converted(self) -> Iterator[None]:
        """Convert errors of SQLite and of the system to errors of this library."""
        try:
            yield
        except sqlite3.OperationalError as error:
            # The lowest byte is the kind of error, the others are details.
            primary_code = error.sqlite_errorcode & 0xFF
            if primary_code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
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

    def _select(self, columns: str, where_key: str, key: str) -> Any:
        """Select from the rows of our settings by a condition on the key.

        Returns:
            The first column of the first row; None without a row.
        """
        query = f"SELECT {columns} FROM results WHERE settings = ? AND {where_key}"
        parameters = (self._settings_sha256, key)
        with self._lock, self._errors_converted():
            row = self._database.execute(query, parameters).fetchone()
        return None if row is None else row[0]

    def __contains__(self, key: Key) -> bool:
        return self._select("1", "key = ?", json.dumps(key)) is not None

    def __len__(self) -> int:
        n_results: int = self._select("count(*)", "key <> ?", _SETTINGS_KEY)
        return n_results

    def add(self, key: Key, value: Value) -> None:
        """Add a result; it survives a crash of this process.

        Raises:
            OutputError: the file cannot be written.
        """
        key_text = json.dumps(key)
        value_text = json.dumps(self._dump(value), allow_nan=False)
        row = (self._settings_sha256, key_text, value_text)
        with self._lock, self._errors_converted():
            self._database.execute("INSERT OR REPLACE INTO results VALUES (?, ?, ?)", row)

    def get(self, key: Key) -> Value | None:
        """Get the result of a key; None if it is unknown.

        Raises:
            OutputError: the file can no longer be read.
            InvalidParameterError: the result is damaged, or has another version.
        """
        value = self._select("value", "key = ?", json.dumps(key))
        if value is None:
            return None
        try:
            return self._load(json.loads(value))
        except _UNREADABLE as error:
            raise InvalidParameterError(
                f"{str(self.path)!r} has an unreadable result of {key} ({error}): {self._remedy}"
            ) from None

    def remove(self) -> None:
        """Delete the file: the run is complete."""
        self.close()
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _difference(earlier: Any, present: Mapping[str, Any]) -> str:
    """List the settings that differ, with their earlier and their present values."""
    before = dict(_leaves("", earlier))
    now = dict(_leaves("", present))
    names = sorted({*before, *now})
    return ", ".join(
        f"{name} {before.get(name)!r} (now {now.get(name)!r})"
        for name in names
        if before.get(name) != now.get(name)
    )


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """List the values in nested settings with their names, joined by points."""
    if not isinstance(value, dict):
        yield name, value
        return
    for inner_name, inner_value in value.items():
        full_name = f"{name}.{inner_name}" if name else inner_name
        yield from _leaves(full_name, inner_value)
