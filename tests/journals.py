"""Journals as a test looks at them, and as a run leaves them that ended earlier."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path


def n_results(path: Path) -> int:
    """The number of results in a file, of all settings."""
    with closing(sqlite3.connect(path)) as file:
        ((found,),) = file.execute("SELECT count(*) FROM results WHERE key <> ''")
    return int(found)


def forget(path: Path, n_forgotten: int) -> None:
    """Delete results, as if the run had ended before them."""
    with closing(sqlite3.connect(path)) as file, file:
        query = "DELETE FROM results WHERE key IN (SELECT key FROM results WHERE key <> '' ORDER BY key DESC LIMIT ?)"
        assert file.execute(query, (n_forgotten,)).rowcount == n_forgotten
