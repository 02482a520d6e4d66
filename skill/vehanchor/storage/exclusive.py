"""Exclusive use of a file on a mount without byte-range locks, such as SMB or Lustre.

SQLite locks its files by ``fcntl``, which such mounts refuse. There it may open a file without
locks (``nolock=1``), if nothing else uses the file. A file of our own beside it shows that: only
one process can create it.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from typing import TYPE_CHECKING

from vehanchor.errors import OutputError
from vehanchor.storage.atomic import beside

if TYPE_CHECKING:
    from pathlib import Path

_SUFFIX = ".lock"
_MAX_BYTES = 1024


def has_locks(folder: Path) -> bool:
    """Test whether files in a folder can be locked."""
    try:
        import fcntl
    except ImportError:  # Windows, where SQLite has other locks
        return True
    probe = folder / f".vehanchor.{os.getpid()}.probe"
    try:
        descriptor = os.open(probe, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError:  # another problem, which SQLite reports
        return True
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
        with suppress(OSError):
            probe.unlink()
    return True


class ExclusiveFile:
    """File that shows that a path is in use; ``release`` removes it.

    Args:
        path: the path to use.

    Raises:
        OutputError: another run is using the path.
        OSError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = beside(path, _SUFFIX)
        self._is_held = True
        if not self._created():
            self._remove_if_abandoned()
            if not self._created():
                raise OutputError(
                    f"another run is using {str(path)!r}: wait until it has ended, or, if none "
                    f"is running, delete {str(self._file)!r}"
                )

    def release(self) -> None:
        """Remove the file, once: later it can be that of another run."""
        if self._is_held:
            self._is_held = False
            self._file.unlink(missing_ok=True)

    def _created(self) -> bool:
        """Create the file; False if it exists."""
        try:
            with self._file.open("x", encoding="utf-8") as file:
                file.write(_this_process())
        except FileExistsError:
            return False
        return True

    def _remove_if_abandoned(self) -> None:
        """Remove the file of a process of this machine that has ended."""
        with suppress(OSError, ValueError):
            with self._file.open(encoding="utf-8") as file:
                host, _, number = file.read(_MAX_BYTES).partition(" ")
            if host == socket.gethostname() and not _is_running(int(number)):
                self._file.unlink()


def _this_process() -> str:
    return f"{socket.gethostname()} {os.getpid()}"


def _is_running(process: int) -> bool:
    """Test whether a process of this machine is running."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # a process of another user
        return True
    return True
