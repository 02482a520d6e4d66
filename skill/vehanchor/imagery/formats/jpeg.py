"""Markers of a JPEG, read in one pass in time proportional to its size.

A marker costs an attacker two bytes, a scan over the whole image four. The reader counts both and
refuses too many.
"""

from __future__ import annotations

import re
import struct
import sys
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageFormatError, ImageTooLargeError
from vehanchor.imagery.formats.ifd import ReadAt, exif_orientation
from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_SCANS = 25
"""Maximum number of scans, each decoded over the whole image.

Progressive JPEGs of mozjpeg have up to as many.
"""

MAX_SEGMENTS = 10_000
"""Maximum number of segments.

512 MiB of metadata in segments of 64 KiB, the largest possible, are 8,192.
"""

EXIF_PREFIX = b"Exif\0\0"

# Markers: DHT, JPG and DAC share the range of SOF, the frame headers. TEM and RSTn have no length.
_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_SOF_ONE_PASS = frozenset({0xC0, 0xC1, 0xC3, 0xC9, 0xCB})
"""Frame headers of sequential and lossless JPEGs; in all others, scans refine earlier ones."""

_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
_SOS = 0xDA
_EOI = 0xD9
_APP1 = 0xE1
_APP14 = 0xEE
_ADOBE = b"Adobe"
_JPEG_LS = 0xF7
_SAMPLE_BITS = 8
_INKS = 4
_STUFFING = 0x00
_FILL = 0xFF

# In entropy-coded data, 0 (stuffing), a restart marker or a fill byte follows 0xFF; anything else
# is a marker.
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_AFTER_FILL = re.compile(rb"\xff[^\xff]")


class _Frame(NamedTuple):
    """Frame header of a JPEG.

    Attributes:
        marker: kind of the JPEG, one of ``_SOF``.
        sample_bits: bits of each sample.
        height_px: rows.
        width_px: columns.
        n_components: bands as stored.
    """

    marker: int
    sample_bits: int
    height_px: int
    width_px: int
    n_components: int


def read_jpeg(read_at: ReadAt) -> ImageHeader:
    """Read the header of a JPEG from its markers; loads the file, because it is decoded whole.

    Raises:
        ImageDecodeError: the file has no frame header, or more than one.
        ImageTooLargeError: the file has more segments or scans than an image needs.
        ImageFormatError: it has 12 bits per sample, inks of unknown meaning, or is a JPEG-LS.
        struct.error: the file ends within the frame header.
    """
    data = read_at(0, sys.maxsize)
    frame: _Frame | None = None
    orientation = 1
    complete = False
    metadata: list[tuple[int, int]] = []
    n_scans = 0
    is_of_adobe = False
    for marker, start, end in _segments(data):
        if marker == _EOI:
            complete = True
        elif marker in _SOF:
            if frame is not None:
                raise ImageDecodeError("the JPEG has two frame headers: damaged")
            bits, height, width, n_components = struct.unpack_from(">BHHB", data, start)
            frame = _Frame(marker, bits, height, width_px=width, n_components=n_components)
        elif marker == _APP14:
            is_of_adobe = is_of_adobe or data.startswith(_ADOBE, start)
        elif marker == _JPEG_LS:
            raise ImageFormatError("this is a JPEG-LS: convert it to JPEG or PNG")
        elif marker == _APP1:
            metadata.append((start, end - start))
            if data.startswith(EXIF_PREFIX, start):
                exif = data[start + len(EXIF_PREFIX) : end]
                orientation = exif_orientation(exif)
        elif marker == _SOS:
            n_scans += 1
            if n_scans > MAX_SCANS:
                raise ImageTooLargeError(
                    f"the JPEG has more than {MAX_SCANS} scans, each covering the whole image; "
                    "save it again as a baseline JPEG"
                )
    if frame is None:
        raise ImageDecodeError("the JPEG has no frame header: truncated or damaged")
    _check_samples(frame, is_of_adobe=is_of_adobe)
    return ImageHeader(
        "JPEG",
        frame.width_px,
        frame.height_px,
        orientation=orientation,
        complete=complete,
        decoding_bytes=_decoding_bytes(frame, n_scans),
        metadata=tuple(metadata),
    )


def _check_samples(frame: _Frame, *, is_of_adobe: bool) -> None:
    """Check that OpenCV decodes the samples of a JPEG rightly.

    Raises:
        ImageFormatError: it does not.
    """
    if frame.sample_bits != _SAMPLE_BITS:
        raise ImageFormatError(
            f"the JPEG has {frame.sample_bits} bits per sample: save it with 8, or as TIFF or PNG "
            "with 16"
        )
    # Adobe stores inks inverted, and OpenCV takes all for such.
    if frame.n_components == _INKS and not is_of_adobe:
        raise ImageFormatError("the JPEG has four inks (CMYK) without Adobe's mark: convert to RGB")


def _segments(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the marker of each segment, and start and end of its content.

    The end marker comes last; without it, the file is truncated or damaged.

    Raises:
        ImageTooLargeError: there are too many segments.
    """
    n_segments = 0
    position = 2
    while True:
        head = data[position : position + 2]
        if len(head) < 2 or head[0] != 0xFF:
            return
        marker = head[1]
        if marker == _FILL:
            position = _find(_AFTER_FILL, data, position)
            continue
        position += 2
        if marker == _EOI:
            yield marker, position, position
            return
        # Some decoders skip stuffing byte by byte, others read it as a segment.
        if marker == _STUFFING:
            return
        n_segments += 1
        if n_segments > MAX_SEGMENTS:
            raise ImageTooLargeError(
                f"the JPEG has more than {MAX_SEGMENTS} segments; save it again without metadata"
            )
        if marker in _STANDALONE:
            continue
        # The length counts its own two bytes.
        length_bytes = data[position : position + 2]
        length = int.from_bytes(length_bytes, "big")
        if len(length_bytes) < 2 or length < 2:
            return
        end = position + length
        yield marker, position + 2, end
        position = end
        # Entropy-coded data follow the header of a scan.
        if marker == _SOS:
            position = _find(_MARKER_IN_SCAN, data, position)


def _find(pattern: re.Pattern[bytes], data: bytes, position: int) -> int:
    """Find the offset of the next match; the end of the data without one."""
    match = pattern.search(data, position)
    return match.start() if match else len(data)


def _decoding_bytes(frame: _Frame, n_scans: int) -> int:
    """Predict the memory that OpenCV takes to decode a JPEG."""
    decoded_bytes = 1 if frame.n_components == 1 else 3
    # If scans refine each other, the decoder holds the 16-bit coefficients of the whole image.
    coefficient_bytes = 0
    if frame.marker not in _SOF_ONE_PASS or n_scans > 1:
        coefficient_bytes = 2 * frame.n_components
    pixel_bytes = max(COPIES * decoded_bytes, decoded_bytes + coefficient_bytes)
    return frame.width_px * frame.height_px * pixel_bytes


JPEG = ImageFormat(
    name="JPEG",
    suffixes=(".jpg", ".jpeg"),
    recognises=starts_with(b"\xff\xd8\xff"),
    read_header=read_jpeg,
)
