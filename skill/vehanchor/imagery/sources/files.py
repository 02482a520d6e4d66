"""Directories, patterns and files in, the list of images out."""

from __future__ import annotations

import glob
import os
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.sources.addresses import is_address

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_SEPARATORS = tuple(filter(None, (os.sep, os.altsep)))
SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".webp", ".avif", ".bmp", ".tif", ".tiff", ".jp2", ".heic"}
)  # what a directory is searched for


def find_images(
    inputs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], *, leave_out: Iterable[Path] = ()
) -> list[str]:
    """Every image once, in an order that depends on the names alone.

    Args:
        inputs: one or several: directories (searched with all below them, by suffix), patterns (``photos/*.jpg``,
            ``**`` too), files, http(s) addresses, which nobody asks before they are read.
            One file of several that does not exist stays in the list, if its name is that of an image: it becomes a
            row with its error.
        leave_out: files that are no images although a pattern finds them, such as the table to be written.

    Returns:
        Paths as they were named: inputs in their order, what each holds sorted.

    Raises:
        ImageNotFoundError: a directory or pattern holds no image, a directory does not exist, none of the images
            does, or no input at all.
    """
    excluded = {str(path.resolve()) for path in leave_out}
    found: dict[str, None] = {}
    named = [inputs] if isinstance(inputs, str | os.PathLike) else inputs
    for name in [os.fspath(each) for each in named]:
        images = [path for path in _images(name) if where_it_is(path) not in excluded]
        if not images:
            raise ImageNotFoundError(f"no image in {name!r}; a directory is searched for {', '.join(sorted(SUFFIXES))}")
        found.update(dict.fromkeys(images))
    if not found:
        raise ImageNotFoundError("no image given: name files, directories or patterns")
    if not any(is_address(image) or Path(image).exists() for image in found):
        raise ImageNotFoundError(f"there is no file {next(iter(found))!r}, nor any other of the {len(found)} named")
    return list(found)


def where_it_is(image: str | os.PathLike[str]) -> str:
    """The one name of an image: its absolute path without links, or its address."""
    return str(image) if is_address(str(image)) else str(Path(image).resolve())


def _images(name: str) -> list[str]:
    if is_address(name):
        return [name]
    path = Path(name)
    if path.is_dir():
        return sorted(str(file) for file in path.rglob("*") if file.suffix.lower() in SUFFIXES and file.is_file())
    if not path.exists() and glob.has_magic(name):
        matches = glob.glob(name, recursive=True)  # noqa: PTH207 - a pattern may be absolute, which Path.glob refuses
        return sorted(file for file in matches if Path(file).is_file())
    if not path.exists() and (name.endswith(_SEPARATORS) or path.suffix.lower() not in SUFFIXES):
        raise ImageNotFoundError(f"there is no file or directory {name!r}")
    return [name]
