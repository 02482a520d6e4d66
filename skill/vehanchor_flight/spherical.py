"""Films of all directions: the projection that a film states for its frames.

Cameras with two or more lenses write it into MP4 as a box ``sv3d`` (Google, Spherical Video V2), or
as XML in a box ``uuid`` (V1), and into Matroska as ``ProjectionType`` (1 equirectangular, 2 cube
map, 3 mesh). Frames of such a film are not perspective views.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes

if TYPE_CHECKING:
    from typing import BinaryIO

MATROSKA_SIGNATURE = b"\x1a\x45\xdf\xa3"
# Tracks stand before the frames in Matroska, and in a box of their own in MP4. Most bytes of each
# that are searched; choices.
_MAX_HEAD_BYTES = 1 << 17
_MAX_TRACKS_BYTES = 32 << 20
_VERSION_2 = re.compile(rb"sv3d.{4}svhd", re.DOTALL)
_VERSION_1 = re.compile(rb"<GSpherical:Spherical>\s*true", re.IGNORECASE)
# Element Projection with its length, and in it ProjectionType of one byte.
_MATROSKA = re.compile(rb"\x76\x70[\x80-\xff].{0,40}?\x76\x71\x81[\x01-\x03]", re.DOTALL)


def stated_projection(path: str) -> str:
    """Name the property by which a film states that its frames are not perspective views.

    Time and memory are bounded.

    Args:
        path: path of the film.

    Returns:
        The property; empty for a perspective view, and if the film states nothing or cannot be
        read.
    """
    try:
        with Path(path).open("rb") as film:
            head = film.read(_MAX_HEAD_BYTES)
            if head.startswith(MATROSKA_SIGNATURE):
                return "ProjectionType of all directions" if _MATROSKA.search(head) else ""
            tracks = _tracks(film)
    except OSError:
        return ""
    if _VERSION_2.search(tracks):
        return "spherical video (sv3d)"
    if _VERSION_1.search(tracks):
        return "spherical video (GSpherical)"
    return ""


def _tracks(film: BinaryIO) -> bytes:
    """Read the box of an MP4 that describes its tracks; empty without one."""

    def read_at(offset: int, count: int) -> bytes:
        film.seek(offset)
        return film.read(count)

    try:
        for box in boxes(read_at):
            if box.kind == b"moov":
                n_bytes = _MAX_TRACKS_BYTES
                if box.end is not None:
                    n_bytes = min(n_bytes, box.end - box.start)
                return read_at(box.start, n_bytes)
    except (ImageDecodeError, ImageTooLargeError, ValueError, OverflowError):
        pass  # not an MP4, or damaged
    return b""
