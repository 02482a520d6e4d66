"""Reading files below the allowed roots, and nothing else.

A path is compared with the roots as it is written: what is not below one is refused without a look at the file system,
so that the refusal tells nothing. From the root's descriptor downwards every part is then opened by itself, never
following a symbolic link. A link is read instead, and the walk goes on by what it says: below the directory that it
lies in, or from a root that it names; one that leads above its root, even to come back, ends the walk unread. The
descriptor that is handed on is the one that was checked, so there is no moment at which the two can differ.

The library gets the open file by the name of its descriptor (``/proc/self/fd/N`` on Linux), which stands for this very
file whatever happens to its path, and which large TIFFs can be read from by windows. Elsewhere it gets the file object,
which is read into memory whole.
"""

from __future__ import annotations

import os
import stat
import sys
from collections import deque
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import urlsplit
from urllib.request import url2pathname

from vehanchor_server.errors import CallError, shortened
from vehanchor_server.images.argument import MAX_PATH_CHARS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)
_CLOEXEC = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
# O_NONBLOCK: a FIFO put in place of the file must not make the opening wait for a writer.
_FILE_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
_DIRECTORY_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | getattr(os, "O_DIRECTORY", 0)


_MAX_LINKS = 40  # as Linux itself
_MAX_LISTED = 100_000  # names that are looked at for a list of images


class PathAccess:
    """The files that callers may name by path.

    Args:
        roots: resolved directories; none refuses every path.
        spellings: how the operator wrote them, in the same order, where that differs; callers may write them so, too.
    """

    def __init__(self, roots: Sequence[Path], spellings: Sequence[Path] = ()) -> None:
        self.roots = tuple(roots)
        self._named = [*zip(roots, roots, strict=True), *zip(spellings, roots, strict=False)]

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
        path = _local_path(named)
        root, below = self._below(path)
        try:
            descriptor = self._opened(root, below)
        except (FileNotFoundError, NotADirectoryError):
            raise _no_image(str(path)) from None
        except (OSError, ValueError):  # a link that was put there just now, a name too long, a directory without access
            raise _refused() from None
        with os.fdopen(descriptor, "rb") as file:
            yield f"/proc/self/fd/{descriptor}" if sys.platform == "linux" else file

    def listed(self, first: int, count: int) -> tuple[list[str], bool]:
        """Name images below the roots by their suffixes; links are not followed, hidden files and folders left out.

        Args:
            first: how many are passed over.
            count: how many are named at most.

        Returns:
            Absolute paths in order, and whether there are more.

        Raises:
            CallError: ``source_disabled``.
        """
        if not self.roots:
            raise CallError(
                "source_disabled", "this server takes no images by path. Use another kind, or start it with --root DIR."
            )
        found = list(
            islice((str(path) for root in self.roots for path in _images_below(root)), first, first + count + 1)
        )
        return found[:count], len(found) > count

    def _below(self, path: Path) -> tuple[Path, tuple[str, ...]]:
        """The root that a path lies below as it is written, and the parts below it; the file system is not asked.

        Raises:
            CallError: ``path_not_allowed``.
        """
        for name, root in self._named:
            if path.is_relative_to(name):
                return root, path.relative_to(name).parts
        raise _refused()

    def _opened(self, root: Path, below: tuple[str, ...]) -> int:
        """The descriptor of the regular file that the parts below a root lead to.

        Raises:
            CallError: a link leads out of the roots, or the parts to something else than a regular file.
            OSError: a part is missing, may not be read, or changed while it was opened.
        """
        if os.open not in os.supports_dir_fd:
            return _open_and_compare(self.roots, root.joinpath(*below))
        n_links = 0
        pending = deque(below)
        walked = [os.open(root, _DIRECTORY_FLAGS)]  # descriptors from the root down to where the walk is
        try:
            while pending:
                part = pending.popleft()
                if part == "..":  # in a link only
                    if len(walked) == 1:
                        raise _refused()
                    os.close(walked.pop())
                    continue
                mode = os.stat(part, dir_fd=walked[-1], follow_symlinks=False).st_mode
                if stat.S_ISLNK(mode):
                    n_links += 1
                    if n_links > _MAX_LINKS:
                        raise _refused()
                    target = Path(os.readlink(part, dir_fd=walked[-1]))
                    parts = target.parts
                    if target.is_absolute():
                        root, parts = self._below(target)
                        while walked:
                            os.close(walked.pop())
                        walked.append(os.open(root, _DIRECTORY_FLAGS))
                    pending.extendleft(reversed(parts))
                elif stat.S_ISDIR(mode):
                    walked.append(_open_part(part, _DIRECTORY_FLAGS, walked[-1]))
                elif stat.S_ISREG(mode) and not pending:  # asked before opening: opening a device can act on it
                    return _regular(_open_part(part, _FILE_FLAGS, walked[-1]), part)
                else:
                    break
            raise _no_image(str(root.joinpath(*below)))
        finally:
            for directory in walked:
                os.close(directory)


def _images_below(root: Path) -> Iterator[Path]:
    """Images below a directory, by folder and name; the walk goes by descriptors, so that no link is followed."""
    from vehanchor.batch.files import SUFFIXES

    walk: Iterator[tuple[Any, ...]] = os.fwalk(root) if hasattr(os, "fwalk") else os.walk(root)
    n_seen = 0
    for folder, folders, names, *_ in walk:
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        n_seen += len(folders) + len(names)
        if n_seen > _MAX_LISTED:
            return
        for name in sorted(names):
            path = Path(folder, name)
            if path.suffix.lower() in SUFFIXES and not name.startswith(".") and not path.is_symlink():
                yield path


def _refused() -> CallError:
    return CallError("path_not_allowed", "the path is not below a directory that this server allows. Use one that is.")


def _no_image(named: str) -> CallError:
    return CallError("image_not_found", f"there is no regular file at {shortened(named)!r}. Check the path.")


def _local_path(named: str) -> Path:
    """A path or file:// URL as an absolute path; the file system is not asked yet."""
    if named[:5].lower() == "file:":
        try:
            parts = urlsplit(named)
        except ValueError:  # an unclosed [
            raise _refused() from None
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
        raise CallError("path_not_allowed", f"{shortened(named)!r} is not an absolute path. Give the whole path.")
    if ".." in path.parts:
        raise CallError("path_not_allowed", "the path contains '..'. Give the path without it.")
    return path


def _open_part(part: str, flags: int, directory: int) -> int:
    """Open one part of a path in an open directory; a link is an error."""
    return os.open(part, flags, dir_fd=directory)


def _regular(descriptor: int, named: str) -> int:
    """The descriptor, if a regular file is open there; else it is closed.

    Raises:
        CallError: ``image_not_found``.
    """
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _no_image(named)
    return descriptor


def _open_and_compare(roots: Sequence[Path], path: Path) -> int:
    """Open a path where directories have no descriptors (Windows), and ask whether it still leads to the same file.

    Raises:
        CallError: it leads out of the roots, or is no regular file.
        OSError: it is missing, or changed while it was opened.
    """
    resolved = path.resolve(strict=False)
    if not any(resolved.is_relative_to(root) for root in roots):
        raise _refused()
    if not stat.S_ISREG(resolved.stat().st_mode):
        raise _no_image(str(path))
    descriptor = os.open(resolved, _FILE_FLAGS)
    if resolved.resolve(strict=True) != resolved or not os.path.samestat(os.fstat(descriptor), resolved.stat()):
        os.close(descriptor)
        raise OSError("the path changed while it was opened")
    return _regular(descriptor, str(path))
