"""Files beside an image that belong to it: its mask of valid pixels, and map coordinates.

GDAL would read them, too, but they can name any other file, so its own readers stay off
(``vehanchor.imagery.sources.rasterio_file``). This module reads the mask, within the limits of an
image, and the map coordinates of a world file, ``.prj`` and ``.aux.xml``
(``vehanchor.imagery.metadata.sidecar_georeference``).
"""

from __future__ import annotations

import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from vehanchor.errors import VehAnchorError
from vehanchor.imagery.metadata.sidecar_georeference import (
    PamGeoreference,
    UnusableSidecarError,
    read_pam,
    read_projection_file,
    read_world_file,
)
from vehanchor.imagery.raster import RasterNote

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeAlias

    from vehanchor.imagery.metadata.georeference import AffineCoefficients

    ReadBeside: TypeAlias = Callable[[str, int], bytes | None]
    """Reads a file in the image's folder by its name, up to a number of bytes; None without one."""

_Parsed = TypeVar("_Parsed")
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

_PAM_SUFFIX = ".aux.xml"
_PROJECTION_SUFFIX = ".prj"
# Largest sizes, bytes: .aux.xml can hold statistics and histograms, which are not read. Choices.
_MAX_PAM_BYTES = 1 << 20
_MAX_PROJECTION_BYTES = 1 << 16
_MAX_WORLD_BYTES = 1 << 12


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

    def georeference(self) -> SidecarGeoreference | None:
        """Read the transform and reference system beside the image; None without a transform.

        ``.aux.xml`` goes before a world file and ``.prj``, as in GDAL.

        Raises:
            UnusableSidecarError: a file is unusable. The message begins with its name.
        """
        pam_names = [self._file_name + _PAM_SUFFIX]
        name, pam = self._parsed(pam_names, _MAX_PAM_BYTES, read_pam)
        if pam is None:
            pam = PamGeoreference(None, None)
        transform = pam.transform
        if transform is None:
            world_names = self._world_names()
            name, transform = self._parsed(world_names, _MAX_WORLD_BYTES, read_world_file)
        if transform is None:
            return None
        system = pam.system
        if system is None:
            projection_names = _spellings(Path(self._file_name).stem, _PROJECTION_SUFFIX)
            _, system = self._parsed(projection_names, _MAX_PROJECTION_BYTES, read_projection_file)
        lack = ""
        if system is None:
            lack = f"{name}: no reference system is stated, such as by a file {projection_names[0]}"
        return SidecarGeoreference(transform, system, lack)

    def _world_names(self) -> list[str]:
        """List the names of world files, the usual one first."""
        stem = Path(self._file_name).stem
        suffix = Path(self._file_name).suffix
        of_format = _WORLD_SUFFIXES.get(suffix.lower(), ())
        names = []
        for world in (*of_format, ".wld"):
            names += _spellings(stem, world)
        return names

    def _parsed(
        self, names: list[str], max_bytes: int, parse: Callable[[bytes], _Parsed]
    ) -> tuple[str, _Parsed | None]:
        """Read the first of these files.

        Returns:
            Its name and content; an empty name and None without one.

        Raises:
            UnusableSidecarError: it is too large, or cannot be parsed.
        """
        for name in names:
            data = self._read(name, max_bytes)
            if data is None:
                continue
            if len(data) > max_bytes:
                raise UnusableSidecarError(f"{name}: it has more than {max_bytes} bytes")
            try:
                return name, parse(data)
            except UnusableSidecarError as error:
                raise UnusableSidecarError(f"{name}: {error}") from error
        return "", None


class SidecarGeoreference(NamedTuple):
    """Georeference beside an image, of its stored pixels.

    Attributes:
        transform: from pixels to coordinates.
        system: a ``rasterio.crs.CRS``; None if no file states it.
        lack: why there is no system; empty with one.
    """

    transform: AffineCoefficients
    system: Any
    lack: str = ""


def unreadable_mask(error: VehAnchorError) -> RasterNote:
    """Warn of a mask that cannot be used."""
    message = f"The mask of valid pixels beside the image is not used: {error}."
    return RasterNote(_UNUSED, message)


def unusable_coordinates(reason: str) -> RasterNote:
    """Warn of a file with map coordinates that is not used.

    Args:
        reason: its name, a colon, and why.
    """
    message = (
        f"Map coordinates beside the image are not used. {reason}. Results have none from there; "
        "write them into the image, such as by gdal_translate."
    )
    return RasterNote(_UNUSED, message)


def _spellings(stem: str, suffix: str) -> list[str]:
    """List a name with its suffix in small and in capital letters."""
    return [stem + suffix, stem + suffix.upper()]


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
