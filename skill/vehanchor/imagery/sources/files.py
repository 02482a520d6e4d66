"""List of the images in directories, patterns and files."""

from __future__ import annotations

import glob
import os
import re
import unicodedata
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.formats.header import SUFFIXES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_SEPARATORS = tuple(separator for separator in (os.sep, os.altsep) if separator)

_SYSTEM_FOLDER = re.compile(
    r"__macosx|\$recycle\.bin|[#@](?:recycle|snapshot|eadir|tmp|__thumb)|thumb(?:nail)?s", re.I
)
"""Folders of systems, network storage and viewers."""


def find_images(inputs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> list[str]:
    """List every image once, in an order that depends on the names alone.

    Args:
        inputs: one or several of

            * directories, searched recursively by suffix, also behind links. Hidden files and the
              folders of systems and viewers are skipped.
            * patterns such as ``photos/*``, also with ``**``; the suffix decides, too.
            * files. A missing file with an image suffix stays in the list if other images exist:
              it becomes a row with an error.

    Returns:
        Paths as the caller named them: inputs in their order, files of each input sorted.

    Raises:
        ImageNotFoundError: a directory or pattern has no image, a directory does not exist, no
            image exists, or no input is given.
    """
    images: dict[str, None] = {}
    named = [inputs] if isinstance(inputs, str | os.PathLike) else inputs
    names = [os.fspath(name) for name in named]
    for name in names:
        images_of_name = _images_named(name)
        if not images_of_name:
            suffixes = ", ".join(sorted(SUFFIXES))
            raise ImageNotFoundError(f"no image in {name!r}: use the suffixes {suffixes}")
        images.update(dict.fromkeys(images_of_name))
    if not images:
        raise ImageNotFoundError("no image given: name files, directories or patterns")
    if not any(Path(image).exists() for image in images):
        first, *others = images
        message = f"there is no file {first!r}"
        if others:
            message += f", nor any of the {len(others)} others"
        raise ImageNotFoundError(message)
    return list(images)


def holds_photographs(name: str) -> bool:
    """Test by its name whether a file or folder can hold photographs.

    False for hidden names, and for folders in which systems and viewers keep their own copies.
    """
    return not name.startswith(".") and not _SYSTEM_FOLDER.fullmatch(name)


def spelled_as_stored(path: str) -> str:
    """Spell a path in the Unicode form (NFC or NFD) in which it exists; others stay unchanged."""
    if path.isascii() or os.path.lexists(path):
        return path
    folder, name = os.path.split(path)
    if folder == path or not name:
        return path
    if folder:
        folder = spelled_as_stored(folder)
    try:
        stored_names = os.listdir(folder or ".")  # noqa: PTH208 - names as they are
    except OSError:
        return path
    composed = unicodedata.normalize("NFC", name)
    for stored_name in sorted(stored_names):
        if unicodedata.normalize("NFC", stored_name) == composed:
            name = stored_name
            break
    return os.path.join(folder, name)  # noqa: PTH118 - keeps the caller's spelling


def canonical_path(image: str | os.PathLike[str]) -> str:
    """Give the unique name of an image: its absolute path without links."""
    path = spelled_as_stored(os.fspath(image))
    try:
        # Path.resolve raises an error for a link to itself.
        return os.path.realpath(path)
    except FileNotFoundError:  # the working directory is gone: no relative path names a file
        return path


def _files_below(top: Path) -> Iterator[Path]:
    """List the files in a folder and, after them, in folders behind links; each folder once."""
    # Links can form circles, so a folder is known by its device and number, not by its path.
    visited: set[tuple[int, int]] = set()
    waiting = [top]
    while waiting:
        links: list[Path] = []
        for start in waiting:
            for folder, subfolders, files in os.walk(start):
                status = Path(folder).stat()
                identity = (status.st_dev, status.st_ino)
                if identity in visited:
                    subfolders.clear()
                    continue
                visited.add(identity)
                subfolders[:] = filter(holds_photographs, subfolders)
                # os.walk does not follow links.
                paths = [Path(folder, name) for name in sorted(subfolders)]
                links += [path for path in paths if path.is_symlink()]
                for name in filter(holds_photographs, files):
                    yield Path(folder, name)
        waiting = links


def _is_image(file: Path) -> bool:
    """Test whether a path is a file with the suffix of an image."""
    return file.suffix.lower() in SUFFIXES and file.is_file()


def _images_named(name: str) -> list[str]:
    """List the images of one directory, pattern or file.

    Raises:
        ImageNotFoundError: it is none of them.
    """
    name = spelled_as_stored(name)
    path = Path(name)
    if path.is_dir():
        images = filter(_is_image, _files_below(path))
        return sorted(map(str, images))
    if path.exists():
        return [name]
    if glob.has_magic(name):
        return _images_of_pattern(name)
    if name.endswith(_SEPARATORS) or path.suffix.lower() not in SUFFIXES:
        raise ImageNotFoundError(f"there is no file or directory {name!r}")
    return [name]


def _images_of_pattern(pattern: str) -> list[str]:
    """List the images that match a pattern, except those in folders of systems and viewers.

    Parts before the first wildcard were named by the caller, so they are never skipped.
    """
    literal_parts = takewhile(lambda part: not glob.has_magic(part), Path(pattern).parts)
    n_literal = len(list(literal_parts))
    images: list[str] = []
    # Path.glob refuses absolute patterns.
    for name in glob.glob(pattern, recursive=True):  # noqa: PTH207
        file = Path(name)
        matched_parts = file.parts[n_literal:]
        if _is_image(file) and all(map(holds_photographs, matched_parts)):
            images.append(name)
    return sorted(images)
