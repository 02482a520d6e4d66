"""Image identity: the state of a file, and a checksum of the pixels, equal for a path, its bytes and its array."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.addresses import is_address

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster

_WINDOWS_PER_SIDE = 8
_WINDOW_PX = 512  # 8 x 8 windows cover 4096 x 4096 px
_DIGITS = 16


class Source(NamedTuple):
    """The state of a file: its key in a journal changes if the file is replaced.

    Attributes:
        path: absolute, links followed; or an address, of which nothing else is known.
        size: bytes; -1 where there is no such file.
        mtime_ns: time of its last change.
    """

    path: str
    size: int
    mtime_ns: int

    @classmethod
    def of(cls, file: str | os.PathLike[str]) -> Source:
        """Read the state of the file of that name."""
        if is_address(os.fspath(file)):
            return cls(os.fspath(file), -1, 0)
        path = Path(file).resolve()
        try:
            facts = path.stat()
        except OSError:
            return cls(str(path), -1, 0)
        return cls(str(path), facts.st_size, facts.st_mtime_ns)


def image_id(raster: Raster) -> str:
    """Hash size and pixels to 16 hexadecimal digits; above 4096 px per side, hash 64 evenly spaced windows."""
    digest = hashlib.sha256(f"{raster.width_px} x {raster.height_px}".encode())
    rows, columns = _spans(raster.height_px), _spans(raster.width_px)
    for y, height in rows:
        for x, width in columns:
            digest.update(raster.read(Window(x, y, width, height)).data)
    return digest.hexdigest()[:_DIGITS]


def _spans(side_px: int) -> list[tuple[int, int]]:
    """Compute the start and length of each window along a side."""
    step = max(_WINDOW_PX, -(-side_px // _WINDOWS_PER_SIDE))
    return [(start, min(_WINDOW_PX, side_px - start)) for start in range(0, side_px, step)]
