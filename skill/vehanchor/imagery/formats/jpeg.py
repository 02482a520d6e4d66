"""Markers of a JPEG, read in one pass in time proportional to its size.

A marker costs an attacker two bytes, a scan over the whole image four. The reader counts both and
refuses too many.
"""

from __future__ import annotations

import re
import struct
import sys

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.ifd import ReadAt, exif_orientation
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader

MAX_SCANS = 25
"""Maximum number of scans, each decoded over the whole image; progressive JPEGs of mozjpeg have up to as many."""

MAX_SEGMENTS = 10_000
"""Maximum number of segments; 512 MiB of metadata in segments of 64 KiB, the largest possible, are 8,192."""

EXIF_PREFIX = b"Exif\0\0"
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # DHT, JPG and DAC share the range
# sequential and lossless; all others refine earlier scans
_SOF_ONE_PASS = frozenset({0xC0, 0xC1, 0xC3, 0xC9, 0xCB})
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # TEM and RSTn carry no length
_SOS = 0xDA
_EOI = 0xD9
_APP1 = 0xE1
_STUFFING = 0x00
# In entropy-coded data, 0 (stuffing), a restart marker or a fill byte follows 0xFF; anything else
# is a marker.
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_AFTER_FILL = re.compile(rb"\xff[^\xff]")


def read_jpeg(read_at: ReadAt) -> ImageHeader:
    """Read the header of a JPEG from its markers; the file is held in memory, since it is decoded whole.

    Raises:
        ImageDecodeError: the file has no frame header, or more than one.
        ImageTooLargeError: the file has more segments or scans than an image needs.
        struct.error: the file ends within the frame header.
    """
    data = read_at(0, sys.maxsize)
    frame: tuple[int, int, int, int] | None = None
    orientation = 1
    complete = False
    metadata: list[tuple[int, int]] = []
    n_segments = n_scans = 0
    position = 2
    while True:
        start = data[position : position + 2]
        if len(start) < 2 or start[0] != 0xFF:
            break
        marker = start[1]
        if marker == 0xFF:  # fill bytes
            found = _AFTER_FILL.search(data, position)
            position = found.start() if found else len(data)
            continue
        # some decoders skip stuffing byte by byte, others read it as a segment
        if marker in (_EOI, _STUFFING):
            complete = marker == _EOI
            break
        n_segments += 1
        if n_segments > MAX_SEGMENTS:
            raise ImageTooLargeError(
                f"the JPEG has more than {MAX_SEGMENTS} segments; save it again without metadata"
            )
        position += 2
        if marker in _STANDALONE:
            continue
        head = data[position : position + 8]
        length = int.from_bytes(head[:2], "big")
        if len(head) < 2 or length < 2:
            break
        if marker in _SOF:
            if frame is not None:
                raise ImageDecodeError("the JPEG has two frame headers: damaged")
            frame = (marker, *struct.unpack_from(">HHB", head, 3))
        elif marker == _APP1:
            metadata.append((position + 2, length - 2))
            if head[2:8] == EXIF_PREFIX:
                orientation = exif_orientation(data[position + 8 : position + length])
        position += length
        if marker == _SOS:
            n_scans += 1
            if n_scans > MAX_SCANS:
                raise ImageTooLargeError(
                    f"the JPEG has more than {MAX_SCANS} scans, each covering the whole image; "
                    "save it again as a "
                    "baseline JPEG"
                )
            found = _MARKER_IN_SCAN.search(data, position)
            position = found.start() if found else len(data)
    if frame is None:
        raise ImageDecodeError("the JPEG has no frame header: truncated or damaged")
    return _header(frame, n_scans, orientation=orientation, complete=complete, metadata=metadata)


def _header(
    frame: tuple[int, int, int, int],
    n_scans: int,
    orientation: int,
    complete: bool,
    metadata: list[tuple[int, int]],
) -> ImageHeader:
    """Predict the memory of a JPEG with this frame: its marker, height, width and number of components."""
    kind, height, width, components = frame
    # the decoder holds the 16-bit coefficients of the whole image
    held = kind not in _SOF_ONE_PASS or n_scans > 1
    shown = 1 if components == 1 else 3
    return ImageHeader(
        "JPEG",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=width
        * height
        * max(COPIES * shown, shown + (2 * components if held else 0)),
        metadata=tuple(metadata),
    )
