"""Path access: open files below the allowed roots, and no others.

The text of a path is compared with the roots. A path outside the roots is refused without access to
the file system, so the refusal reveals nothing. Below a root, each component is opened from its
parent's descriptor without following symbolic links. A link is read, and the walk continues at its
target: below the link's directory, or from a root that the target names. A target above the root
ends the walk, even if it returns. The library gets the checked descriptor, so the file cannot
change between check and use.

Names in calls are Unicode, and files are named by bytes of UTF-8, whatever the server's locale.
Between both, names have the form that Python opens.

On Linux the library gets the name of the descriptor (``/proc/self/fd/N``). The name refers to the
same file whatever happens to its path, and supports windowed reading of large TIFFs. Elsewhere it
gets the file object and reads it whole.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections import deque
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from unicodedata import normalize
from urllib.parse import urlsplit
from urllib.request import url2pathname

from vehanchor_server.errors import CallError, shortened
from vehanchor_server.images.argument import MAX_PATH_CHARS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

_NOFOLLOW = getattr(os, "O_NOFOLLOW", 0)
_CLOEXEC = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
# O_NONBLOCK: opening a FIFO in place of the file must not wait for a writer.
_NO_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
_FILE_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | _NO_WAITING
_DIRECTORY_FLAGS = os.O_RDONLY | _NOFOLLOW | _CLOEXEC | getattr(os, "O_DIRECTORY", 0)

# Names of other places: schemes such as local:// and data:, a home directory, a variable, and, but
# on Windows, a drive or a share of it.
_FOREIGN_PLACES = r"[a-z][a-z0-9+.-]+://|(data|blob|cid|sandbox|attachment):|~|\$\{?[a-z]|%[a-z]+%"
_WINDOWS_PLACES = r"|[a-z]://|[a-z]:[\\/]|\\\\"
_FOREIGN_PATH = re.compile(
    _FOREIGN_PLACES + (_WINDOWS_PLACES if os.name == "posix" else ""), re.IGNORECASE
)
_CALLS_ENCODING = "utf-8"
_MAX_LINKS = 40  # the limit of Linux
_MAX_NAMED = 4  # roots, or similar names, in an error
_MAX_LISTED = 100_000  # visited names per list of images
_MAX_COMPARED = 5000  # names that are compared with a name without a file


class PathAccess:
    """Access to files by path.

    Args:
        roots: resolved directories; an empty sequence refuses every path.
        spellings: the roots as given by the operator, in the same order; callers may use both
            forms.
    """

    def __init__(self, roots: Sequence[Path], spellings: Sequence[Path] = ()) -> None:
        self.roots = tuple(roots)
        # Each accepted spelling of a root, with the root.
        self._spellings = [(root, root) for root in roots]
        self._spellings += zip(spellings, roots, strict=False)

    @contextmanager
    def open(self, named: str) -> Iterator[str | BinaryIO]:
        """Open a file for the duration of the context.

        Args:
            named: an absolute path, a ``file://`` URL, or a path below a root; the first root with
                such a file wins.

        Yields:
            The name of the descriptor, or a file object on systems without such names.

        Raises:
            CallError: ``source_disabled``; ``path_not_allowed``, the same for existing and missing
                files outside the roots; ``image_not_found`` for a path below a root that is not a
                regular file.
        """
        # The process that listens imports no decoder.
        from vehanchor.imagery.sources.sidecars import OpenPath

        self._check_enabled()
        path = self._local_path(named)
        descriptor = self._descriptor(path)
        with os.fdopen(descriptor, "rb") as file:
            if sys.platform == "linux":
                name = f"/proc/self/fd/{descriptor}"
                yield OpenPath.of(name, path.name, partial(self._read_beside, path))
            else:
                yield file

    def _read_beside(self, path: Path, name: str, max_bytes: int) -> bytes | None:
        """Read a file beside an image, under the same checks; None if it cannot be read.

        Args:
            path: path of the image, as the caller named it.
            name: name of the file.
            max_bytes: one byte more shows that the file is larger.
        """
        try:
            descriptor = self._descriptor(path.with_name(name), suggest=False)
            with os.fdopen(descriptor, "rb") as file:
                return file.read(max_bytes + 1)
        except (CallError, OSError, ValueError):
            return None

    def listed(
        self, first: int, count: int, check_stop: Callable[[], None] | None = None
    ) -> tuple[list[str], int]:
        """List regular files below the roots that have an image's suffix.

        Links and hidden files or folders are left out, and names with control characters or bytes
        that are not UTF-8: they would end a transport, or reach a model as lines of their own.

        Args:
            first: number of images to skip.
            count: maximum number of images.
            check_stop: called for each folder; raises to end the walk.

        Returns:
            Absolute paths in order, and the number of all images.

        Raises:
            CallError: ``source_disabled``.
        """
        self._check_enabled()
        paths = [
            _as_sent(str(path)) for root in self.roots for path in _images_below(root, check_stop)
        ]
        return paths[first : first + count], len(paths)

    def first(self) -> str | None:
        """Return the first image, relative to its root, for an example; None without one."""
        return next(self._relative_images(), None)

    def _relative_images(self) -> Iterator[str]:
        """List the images below all roots, relative to their root."""
        for root in self.roots:
            for path in _images_below(root):
                yield _as_sent(path.relative_to(root).as_posix())

    def _nearest(self, name: str) -> list[str]:
        """Return the images below the roots with the nearest names."""
        paths = {}
        for path in islice(self._relative_images(), _MAX_COMPARED):
            file_name = path.rpartition("/")[2].lower()
            paths[file_name] = path
        similar = get_close_matches(name.lower(), paths, n=_MAX_NAMED)
        return [shortened(paths[file_name]) for file_name in similar]

    def _check_enabled(self) -> None:
        if not self.roots:
            raise CallError(
                "source_disabled",
                "this server takes no images by path. Use another kind, or start it with --root "
                "DIR.",
            )

    def _local_path(self, named: str) -> Path:
        """Convert a path or file:// URL to a path without access to the file system."""
        if named[:8].lower().startswith(("http://", "https://")):
            raise CallError(
                "image_not_found",
                "this is a URL, not a path. Give a file's path, or kind url if it is listed.",
            )
        if named[:5].lower() != "file:" and _FOREIGN_PATH.match(named):
            raise CallError(
                "image_not_found",
                f"{shortened(named)!r} is no path on this server, which cannot see files of your "
                "own sandbox. Call view_image without image: it lists the images. Or send the "
                "image's bytes, if kind base64 is listed.",
            )
        if named[:5].lower() == "file:":
            named = self._path_in_url(named)
        if "\0" in named or len(named) > MAX_PATH_CHARS:
            raise self._refused()
        path = Path(self._as_stored(named))
        if ".." in path.parts:
            raise CallError("path_not_allowed", "the path contains '..'. Give the path without it.")
        return path

    def _as_stored(self, named: str) -> str:
        """Convert a name of a call to the one by which Python opens the file in this locale."""
        if sys.getfilesystemencoding() == _CALLS_ENCODING:
            return named
        try:
            return os.fsdecode(named.encode(_CALLS_ENCODING))
        except UnicodeEncodeError:  # half a character
            raise self._refused() from None

    def _path_in_url(self, url: str) -> str:
        """Return the path that a file:// URL names on this machine."""
        try:
            parts = urlsplit(url)
        except ValueError:  # an unclosed [
            raise self._refused() from None
        is_local = url[5:7] == "//" and parts.netloc in ("", "localhost")
        if not is_local or parts.query or parts.fragment:
            raise CallError(
                "path_not_allowed",
                "a file:// URL must name this machine: file:///absolute/path, without query "
                "or fragment.",
            )
        try:
            return url2pathname(parts.path)
        except OSError:
            raise self._refused() from None

    def _refused(self) -> CallError:
        # The operator's own spellings, if there are any: callers know them.
        spellings = [name for name, _ in self._spellings[-len(self.roots) :]]
        roots = " or ".join(shortened(_as_sent(str(name))) for name in spellings[:_MAX_NAMED])
        return CallError(
            "path_not_allowed",
            f"the path is not below an allowed directory of this server: {roots}. Use a path "
            "below it, absolute or relative to it; view_image without image lists the images.",
        )

    def _descriptor(self, path: Path, *, suggest: bool = True) -> int:
        """Open an absolute path, or a relative one below the first root that has such a file.

        Args:
            path: the path.
            suggest: whether the error for a missing file lists the nearest names.
        """
        candidates = [path] if path.is_absolute() else [root / path for root in self.roots]
        missing: CallError | None = None
        for candidate in candidates:
            root, below = self._split(candidate)
            try:
                return self._opened(root, below)
            except (FileNotFoundError, NotADirectoryError):
                nearest = self._nearest(path.name) if suggest else ()
                missing = _no_image(_as_sent(str(path)), nearest)
            except CallError as error:
                if error.code != "image_not_found":
                    raise
                missing = error
            except (OSError, ValueError):  # a new link, a long name, or a directory without access
                raise self._refused() from None
        assert missing is not None
        raise missing

    def _split(self, path: Path) -> tuple[Path, tuple[str, ...]]:
        """Split a path, by its text alone, into its root and the components below the root.

        Raises:
            CallError: ``path_not_allowed``.
        """
        for name, root in self._spellings:
            if _nfc(path).is_relative_to(_nfc(name)):
                return root, path.parts[len(name.parts) :]
        raise self._refused()

    def _opened(self, root: Path, below: tuple[str, ...]) -> int:
        """Open the regular file at the components below a root; return its descriptor.

        An ``OSError`` means that a component is missing, unreadable, or changed during the walk.
        """
        if os.open not in os.supports_dir_fd:
            return self._open_and_compare(root.joinpath(*below))
        n_links = 0
        pending = deque(below)
        # Descriptors from the root to the current directory: ".." in a link goes back along them,
        # and never above the root.
        walked = [os.open(root, _DIRECTORY_FLAGS)]
        try:
            while pending:
                part = pending.popleft()
                if part == "..":  # only in a link
                    if len(walked) == 1:
                        raise self._refused()
                    os.close(walked.pop())
                    continue
                directory = walked[-1]
                part = _spelled_as_stored(part, directory)
                mode = os.stat(part, dir_fd=directory, follow_symlinks=False).st_mode
                if stat.S_ISLNK(mode):
                    n_links += 1
                    if n_links > _MAX_LINKS:
                        raise self._refused()
                    target = Path(os.readlink(part, dir_fd=directory))
                    parts = target.parts
                    # An absolute target begins anew at the root that it names.
                    if target.is_absolute():
                        root, parts = self._split(target)
                        while walked:
                            os.close(walked.pop())
                        walked.append(os.open(root, _DIRECTORY_FLAGS))
                    pending.extendleft(reversed(parts))
                elif stat.S_ISDIR(mode):
                    walked.append(_open_part(part, _DIRECTORY_FLAGS, directory))
                # Checked before it is opened: opening a device can have effects.
                elif stat.S_ISREG(mode) and not pending:
                    return _regular(_open_part(part, _FILE_FLAGS, directory), part)
                else:
                    break
            named = shortened(_as_sent(str(root.joinpath(*below))))
            if not pending and stat.S_ISDIR(os.fstat(walked[-1]).st_mode):
                raise CallError(
                    "image_not_found",
                    f"{named!r} is a folder. Name a file in it; view_image lists them.",
                )
            raise _no_image(named)
        finally:
            for directory in walked:
                os.close(directory)

    def _open_and_compare(self, path: Path) -> int:
        """Open a path on systems without directory descriptors (Windows).

        Afterwards, check that the path still names the same file.
        """
        resolved = path.resolve(strict=False)
        if not any(resolved.is_relative_to(root) for root in self.roots):
            raise self._refused()
        if not stat.S_ISREG(resolved.stat().st_mode):
            raise _no_image(_as_sent(str(path)))
        descriptor = os.open(resolved, _FILE_FLAGS)
        try:
            # The file may be gone: then this raises.
            is_same_path = resolved.resolve(strict=True) == resolved
            if not is_same_path or not os.path.samestat(os.fstat(descriptor), resolved.stat()):
                raise OSError("the path changed while it was opened")
        except BaseException:
            os.close(descriptor)
            raise
        return _regular(descriptor, str(path))


def _images_below(root: Path, check_stop: Callable[[], None] | None = None) -> Iterator[Path]:
    """List images below a directory, by folder and name.

    The walk uses descriptors where the system has them, so that it follows no link.
    """
    from vehanchor.imagery.formats.header import SUFFIXES
    from vehanchor.imagery.sources.files import holds_photographs

    walk: Iterator[tuple[Any, ...]]
    walk = os.fwalk(root) if hasattr(os, "fwalk") else os.walk(root)
    n_visited = 0
    for folder, subfolders, names, *_ in walk:
        if check_stop is not None:
            check_stop()
        # The walk enters the folders that remain in this list, in its order.
        subfolders[:] = sorted(
            name for name in subfolders if holds_photographs(name) and _as_sent(name).isprintable()
        )
        n_visited += len(subfolders) + len(names)
        if n_visited > _MAX_LISTED:
            return
        for name in sorted(names):
            path = Path(folder, name)
            if path.suffix.lower() not in SUFFIXES:
                continue
            if not holds_photographs(name) or not _as_sent(name).isprintable():
                continue
            with suppress(OSError):  # the file is gone
                if stat.S_ISREG(path.lstat().st_mode):
                    yield path


def _as_sent(name: str) -> str:
    """Convert a name of the file system to Unicode; bytes that are not UTF-8 become surrogates."""
    if sys.getfilesystemencoding() == _CALLS_ENCODING:
        return name
    return os.fsencode(name).decode(_CALLS_ENCODING, "surrogateescape")


def _no_image(named: str, nearest: Sequence[str] = ()) -> CallError:
    remedy = "Check the path; view_image without image lists the images."
    if nearest:
        remedy = f"The nearest names are {', '.join(nearest)}."
    message = f"there is no regular file at {shortened(named)!r}. {remedy}"
    return CallError("image_not_found", message)


def _nfc(path: Path) -> Path:
    """Spell a path in the Unicode form NFC."""
    return Path(normalize("NFC", str(path)))


def _spelled_as_stored(part: str, directory: int) -> str:
    """Spell a component of a path as the open directory does.

    macOS writes NFD where others write NFC.
    """
    with suppress(FileNotFoundError):
        os.stat(part, dir_fd=directory, follow_symlinks=False)
        return part
    if part.isascii():
        return part
    composed = normalize("NFC", part)
    for name in sorted(os.listdir(directory)):
        if normalize("NFC", name) == composed:
            return name
    return part


def _open_part(part: str, flags: int, directory: int) -> int:
    """Open a component of a path in an open directory; fail on a link."""
    return os.open(part, flags, dir_fd=directory)


def _regular(descriptor: int, named: str) -> int:
    """Return the descriptor of a regular file; close and refuse any other."""
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise _no_image(named)
    return descriptor
