"""Files beside an image that belong to it: its mask of valid pixels, and map coordinates.

GDAL would read more of them, but they can name any other file, so its own readers stay off
(``vehanchor.imagery.sources.rasterio_file``). This module reads the mask alone, within the limits
of an image, and names the others, which are not used.
"""

from __future__ import annotations

import stat
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import VehAnchorError
from vehanchor.imagery.raster import RasterNote

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    ReadBeside: TypeAlias = Callable[[str, int], bytes | None]
    """Reads a file in the image's folder by its name, up to a number of bytes; None without one."""

_UNUSED = "sidecar_unused"
_MASK_SUFFIX = ".msk"
_WORLD_SUFFIXES = {
    ".tif": (".tfw", ".tifw"),
    ".tiff": (".tfw", ".tiffw"),
    ".jpg": (".jgw", ".jpgw"),
    ".jpeg": (".jgw", ".jpegw"),
    ".png": (".pgw", ".pngw"),
    ".jp2": (".j2w", ".jp2w"),
}
"""Suffixes of world files by the image's suffix; ``.wld`` is common to all."""


class OpenPath(str):
    """Name of an open file whose folder only its owner may read, such as a descriptor's name.

    Attributes:
        file_name: name of the image in its folder.
        read_beside: reads files of that folder.
    """

    __slots__ = ("file_name", "read_beside")
    file_name: str
    read_beside: ReadBeside

    @classmethod
    def of(cls, name: str, file_name: str, read_beside: ReadBeside) -> OpenPath:
        """Make the name of an open file."""
        path = cls(name)
        path.file_name = file_name
        path.read_beside = read_beside
        return path


class Sidecars:
    """Files beside an image.

    Args:
        path: path of the image, or the name of an open file.
    """

    def __init__(self, path: str) -> None:
        if isinstance(path, OpenPath):
            self._file_name = path.file_name
            self._read = path.read_beside
        else:
            self._file_name = Path(path).name
            self._read = _reader_of(Path(path).parent)

    def mask(self, max_bytes: int) -> bytes | None:
        """Read the mask of valid pixels, a TIFF; None without one."""
        return self._read(self._file_name + _MASK_SUFFIX, max_bytes)

    def unused(self) -> tuple[RasterNote, ...]:
        """Warn of a file with map coordinates, which is not used."""
        stem = Path(self._file_name).stem
        suffix = Path(self._file_name).suffix
        of_format = _WORLD_SUFFIXES.get(suffix.lower(), ())
        names = [stem + world for world in (*of_format, ".wld")]
        names.append(self._file_name + ".aux.xml")
        for name in names:
            if self._read(name, 1) is None:
                continue
            message = (
                f"The file {name} beside the image is not used: results have no map coordinates "
                "from it. Write them into the image, such as by gdal_translate."
            )
            return (RasterNote(_UNUSED, message),)
        return ()


def unreadable_mask(error: VehAnchorError) -> RasterNote:
    """Warn of a mask that cannot be used."""
    message = f"The mask of valid pixels beside the image is not used: {error}."
    return RasterNote(_UNUSED, message)


def _reader_of(folder: Path) -> ReadBeside:
    """Make a function that reads regular files of a folder."""

    def read(name: str, max_bytes: int) -> bytes | None:
        path = folder / name
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                return None
            with path.open("rb") as file:
                return file.read(max_bytes + 1)
        except (OSError, ValueError):  # there is none, or the name has a NUL
            return None

    return read
