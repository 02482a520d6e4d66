"""Environment variables of workers: a minimum, because a compromised worker can read them."""

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
        "LANG",
        "LC_ALL",
        "LC_CTYPE",
        "TZ",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "ORT_DISABLE_TELEMETRY",
        "PYTHONHASHSEED",
        "PYTHONWARNINGS",
        # Windows starts no process without SYSTEMROOT.
        "SYSTEMROOT",
        "TEMP",
        "TMP",
        "NUMBER_OF_PROCESSORS",
    }
)
SEARCH_PATHS = ("LD_LIBRARY_PATH", "PYTHONPATH")
_one_at_a_time = threading.Lock()  # the environment belongs to all threads


@contextmanager
def minimal_environment() -> Iterator[None]:
    """Reduce this process's environment to a minimum while a child process starts and inherits it.

    Secrets, such as tokens, are removed. Search paths for libraries and modules keep only absolute
    folders.
    """
    with _one_at_a_time:
        whole = dict(os.environ)
        kept = {name: value for name, value in whole.items() if name in KEPT}
        for name in SEARCH_PATHS:
            folders = absolute_folders(whole.get(name, ""))
            if folders:
                kept[name] = os.pathsep.join(folders)
        try:
            for name in whole.keys() - kept.keys():
                # Another thread may have removed it meanwhile.
                os.environ.pop(name, None)
            os.environ.update(kept)
            yield
        finally:
            os.environ.update(whole)


def absolute_folders(paths: str) -> list[str]:
    """Return the absolute folders of a search path.

    Others, such as an empty entry, depend on the working directory.
    """
    return [entry for entry in paths.split(os.pathsep) if Path(entry).is_absolute()]
