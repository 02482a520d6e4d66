"""Environment variables of workers: few, because a compromised worker reads all of them."""

from __future__ import annotations

import os
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

KEPT = frozenset(
    {
        *("LANG", "LC_ALL", "LC_CTYPE", "TZ", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"),
        *("ORT_DISABLE_TELEMETRY", "PYTHONHASHSEED", "PYTHONWARNINGS"),
        *("SYSTEMROOT", "TEMP", "TMP", "NUMBER_OF_PROCESSORS"),  # Windows starts no process without the first
    }
)
SEARCH_PATHS = ("LD_LIBRARY_PATH", "PYTHONPATH")
_one_at_a_time = threading.Lock()


@contextmanager
def minimal_environment() -> Iterator[None]:
    """Leave few variables in this process's environment while a process starts, which inherits them.

    Secrets, such as a token, stay out. Of search paths for libraries and modules only absolute folders stay.
    """
    with _one_at_a_time:
        whole = dict(os.environ)
        kept = {name: value for name, value in whole.items() if name in KEPT}
        for name in SEARCH_PATHS:
            if folders := absolute_folders(whole.get(name, "")):
                kept[name] = os.pathsep.join(folders)
        try:
            for name in whole.keys() - kept.keys():
                del os.environ[name]
            os.environ.update(kept)
            yield
        finally:
            os.environ.update(whole)


def absolute_folders(paths: str) -> list[str]:
    """Folders of a search path that are absolute; an empty entry would be the working directory."""
    return [entry for entry in paths.split(os.pathsep) if Path(entry).is_absolute()]
