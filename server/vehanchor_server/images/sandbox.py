"""Reading files below the allowed roots, and nothing else.

A path is resolved and compared with the roots, and then opened anew from the root downwards, one directory descriptor
at a time, never following a symbolic link. A resolved path has none, so a link met on the way was put there between the
check and the opening, and the walk ends: there is no moment at which what was checked and what is opened can differ.

The library gets the open file by the name of its descriptor (``/proc/self/fd/N`` on Linux), which stands for this very
file whatever happens to its path, and which large TIFFs can be read from by windows. Elsewhere it gets the file object,
which is read into memory whole.
"""

from __future__ import annotations

import os
import stat
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from urllib.parse import urlsplit
from urllib.request import url2pathname

from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import MAX_PATH_CHARS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

__all__ = ["Sandbox"]

_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)
_CLOEXEC = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
# O_NONBLOCK: a FIFO put in place of the file must not make the opening wait for a writer.
_FILE_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
_DIRECTORY_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | getattr(os, "O_DIRECTORY", 0)


class Sandbox:
    """The files that callers may name by path.

    Args:
        roots: resolved directories; none refuses every path.
    """

    def __init__(self, roots: Sequence[Path]) -> None:
        self.roots = tuple(roots)

    @contextmanager
    def open(self, named: str) -> Iterator[str | BinaryIO]:
        """Open the file that a caller named, for as long as the context lasts.

        Args:
            named: an absolute path or a ``file://`` URL.

        Yields:
            The file for the library: the name of the descriptor, or a file object where the system has no such name.

        Raises:
            CallError: ``source_disabled``, ``path_not_allowed``, or ``image_not_found`` for a name below a root that is
                no regular file. Outside the roots, what exists and what does not are refused alike.
        """
        if not self.roots:
            raise CallError(
                "source_disabled", "this server takes no images by path. Use another kind, or start it with --root DIR."
            )
        path, root = self._resolved(_local_path(named))
        try:
            descriptor = _open_below(root, path)
        except OSError:
            raise _refused() from None  # what was resolved a moment ago is no longer there, or is now a link
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise _no_image(named)
        with os.fdopen(descriptor, "rb") as file:
            yield f"/proc/self/fd/{descriptor}" if sys.platform == "linux" else file

    def _resolved(self, path: Path) -> tuple[Path, Path]:
        """The path without links, and the root it lies below; checked on what it names now."""
        try:
            resolved = path.resolve(strict=False)
            root = next((root for root in self.roots if resolved.is_relative_to(root)), None)
            if root is None:
                raise _refused()
            if not stat.S_ISREG(os.lstat(resolved).st_mode):  # asked before opening: opening a device can act on it
                raise _no_image(str(path))
        except FileNotFoundError:
            raise _no_image(str(path)) from None
        except (OSError, RuntimeError, ValueError):  # a loop of links, a name too long for the file system
            raise _refused() from None
        return resolved, root


def _refused() -> CallError:
    return CallError("path_not_allowed", "the path is not below a directory that this server allows. Use one that is.")


def _no_image(named: str) -> CallError:
    return CallError("image_not_found", f"there is no regular file at {named!r}. Check the path.")


def _local_path(named: str) -> Path:
    """A path or file:// URL as an absolute path; the file system is not asked yet."""
    if named[:5].lower() == "file:":
        parts = urlsplit(named)
        if parts.netloc not in ("", "localhost") or parts.query or parts.fragment or not named[5:7] == "//":
            raise CallError(
                "path_not_allowed", "a file:// URL must name this machine: file:///absolute/path, nothing after it."
            )
        try:
            named = url2pathname(parts.path)
        except OSError:
            raise _refused() from None
    if "\0" in named or len(named) > MAX_PATH_CHARS:
        raise _refused()
    path = Path(named)
    if not path.is_absolute():
        raise CallError("path_not_allowed", f"{named[:80]!r} is not an absolute path. Give the whole path.")
    if ".." in path.parts:
        raise CallError("path_not_allowed", "the path contains '..'. Give the path without it.")
    return path


def _open_below(root: Path, path: Path) -> int:
    """Open a resolved path below a root without following a single link.

    Raises:
        OSError: a part of it is missing, or is a link by now.
    """
    if os.open not in os.supports_dir_fd:  # Windows: open, then ask whether the path still leads to the same file
        descriptor = os.open(path, _FILE_FLAGS)
        if path.resolve(strict=True) != path or not os.path.samestat(os.fstat(descriptor), path.stat()):
            os.close(descriptor)
            raise OSError("the path changed while it was opened")
        return descriptor
    directory = os.open(root, _DIRECTORY_FLAGS)
    try:
        *parents, name = path.relative_to(root).parts
        for parent in parents:
            below = os.open(parent, _DIRECTORY_FLAGS, dir_fd=directory)
            os.close(directory)
            directory = below
        return os.open(name, _FILE_FLAGS, dir_fd=directory)
    finally:
        os.close(directory)
