"""List of the images in directories, patterns and files."""

from __future__ import annotations

import glob
import os
import re
import unicodedata
from itertools import chain, takewhile
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.formats.header import IMAGE_FORMATS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

_SEPARATORS = tuple(filter(None, (os.sep, os.altsep)))
SUFFIXES = frozenset(chain.from_iterable(IMAGE_FORMATS.values()))
"""Suffixes of the images in directories."""

_SYSTEM_FOLDER = re.compile(
    r"__macosx|\$recycle\.bin|[#@](?:recycle|snapshot|eadir|tmp|__thumb)|thumb(?:nail)?s", re.I
)
"""Folders of systems, network storage and viewers."""


def find_images(inputs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]) -> list[str]:
    """List every image once, in an order that depends on the names alone.

    Args:
        inputs: one or several: directories (searched by suffix, recursively, also behind links, but
            not hidden files and the folders of systems and viewers), patterns (``photos/*``, also
            ``**``; by suffix, too), and files. A missing file with an image suffix stays in the
            list if other images exist: it becomes a row with an error.

    Returns:
        Paths as the caller named them: inputs in their order, files of each input sorted.

    Raises:
        ImageNotFoundError: a directory or pattern has no image, a directory does not exist, no
            image exists, or no input is given.
    """
    found: dict[str, None] = {}
    named = [inputs] if isinstance(inputs, str | os.PathLike) else inputs
    for name in [os.fspath(each) for each in named]:
        images = _images(name)
        if not images:
            raise ImageNotFoundError(
                f"no image in {name!r}: use the suffixes {', '.join(sorted(SUFFIXES))}"
            )
        found.update(dict.fromkeys(images))
    if not found:
        raise ImageNotFoundError("no image given: name files, directories or patterns")
    if not any(Path(image).exists() for image in found):
        raise ImageNotFoundError(
            f"there is no file {next(iter(found))!r}, nor any other of the {len(found)} named"
        )
    return list(found)


def holds_photographs(name: str) -> bool:
    """Test by its name whether a file or folder in a directory is no copy that a system or viewer keeps for itself."""
    return not name.startswith(".") and not _SYSTEM_FOLDER.fullmatch(name)


def existing(path: str) -> str:
    """Give a path that exists in another Unicode form (NFC or NFD) in that form; other paths unchanged."""
    if path.isascii() or os.path.lexists(path):
        return path
    folder, name = os.path.split(path)
    if folder == path or not name:
        return path
    folder = existing(folder) if folder else folder
    wanted = unicodedata.normalize("NFC", name)
    try:
        names = os.listdir(folder or ".")  # noqa: PTH208 - names as they are
    except OSError:
        return path
    found = (each for each in sorted(names) if unicodedata.normalize("NFC", each) == wanted)
    return os.path.join(folder, next(found, name))  # noqa: PTH118 - keeps the caller's spelling


def where_it_is(image: str | os.PathLike[str]) -> str:
    """Give the unique name of an image: its absolute path without links."""
    return str(Path(existing(os.fspath(image))).resolve())


def _files(folder: Path) -> Iterator[Path]:
    """List the files in a folder and, after them, in folders behind links; each folder once."""
    known: set[tuple[int, int]] = set()
    waiting = [folder]
    while waiting:
        links: list[Path] = []
        for top in waiting:
            for here, folders, files in os.walk(top):
                state = Path(here).stat()
                if (state.st_dev, state.st_ino) in known:
                    folders.clear()
                    continue
                known.add((state.st_dev, state.st_ino))
                folders[:] = filter(holds_photographs, folders)
                links += [
                    path for each in sorted(folders) if (path := Path(here, each)).is_symlink()
                ]
                yield from (Path(here, each) for each in files if holds_photographs(each))
        waiting = links


def _is_image(file: Path) -> bool:
    return file.suffix.lower() in SUFFIXES and file.is_file()


def _images(name: str) -> list[str]:
    name = existing(name)
    path = Path(name)
    if path.is_dir():
        return sorted(str(file) for file in _files(path) if _is_image(file))
    if not path.exists() and glob.has_magic(name):
        matches = glob.glob(name, recursive=True)  # noqa: PTH207 - Path.glob refuses absolute patterns
        fixed = len(list(takewhile(lambda part: not glob.has_magic(part), path.parts)))
        return sorted(
            file
            for file in matches
            if _is_image(Path(file)) and all(map(holds_photographs, Path(file).parts[fixed:]))
        )
    if not path.exists() and (name.endswith(_SEPARATORS) or path.suffix.lower() not in SUFFIXES):
        raise ImageNotFoundError(f"there is no file or directory {name!r}")
    return [name]
