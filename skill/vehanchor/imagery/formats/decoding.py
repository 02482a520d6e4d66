"""Decoding images whole, with OpenCV, after their headers have been read and checked."""

from __future__ import annotations

import re
import threading
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, OutOfMemoryError
from vehanchor.imagery.formats.header import picture_chunks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.imagery.formats.header import ImageHeader, TiffLayout

_SILENT = 0
_NO_MEMORY = -4  # cv::Error::StsNoMem


def decode(data: bytes, source: str, header: ImageHeader) -> NDArray[Any]:
    """Decode an image: ``[h, w]`` or ``[h, w, 3 or 4]`` in BGR order, depth as stored.

    OpenCV turns TIFFs by their orientation tag even when told to leave the image unchanged, and nothing else.

    Args:
        data: the encoded image.
        source: what to call it.
        header: what it says of itself.

    Raises:
        ImageDecodeError: it is truncated or damaged.
        OutOfMemoryError: there is too little memory for it now.
    """
    if not header.complete:
        raise ImageDecodeError(f"the {header.format} ({source}) is truncated: its end mark is missing")
    if header.format == "PNG":
        data = picture_chunks(data)
    if header.format == "AVIF" and not _decodes_avif():
        raise ImageDecodeError(
            f"this OpenCV, {cv2.__version__}, reads no AVIF ({source}): pip install -U opencv-python-headless, or "
            "convert it to JPEG"
        )
    try:
        with _QUIET_OPENCV.entered():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        if isinstance(error, MemoryError) or error.code == _NO_MEMORY:
            size = f"{header.width_px} x {header.height_px} px"
            raise OutOfMemoryError(f"no memory for the {header.format} of {size}: try again later") from error
        raise ImageDecodeError(f"the {header.format} ({source}) cannot be decoded: {error.err}") from error
    # None is in no older OpenCV's type of the result, but in every one's behaviour.
    if pixels is None or sorted(pixels.shape[:2]) != sorted((header.height_px, header.width_px)):
        raise ImageDecodeError(f"the {header.format} ({source}) cannot be decoded: truncated or damaged")
    return pixels


def decodes_tiff(layout: TiffLayout) -> bool:
    """Whether OpenCV decodes such a TIFF without loss or misreading."""
    if layout.bands not in (1, 3, 4) or layout.planar:
        return False
    bits = set(layout.bits)
    if layout.sample_format == 3:
        return bits in ({32}, {64}) and layout.photometric in (1, 2)
    white_is_zero = layout.photometric == 0 and bits in ({1}, {8})
    return (
        layout.sample_format == 1 and bits in ({1}, {8}, {16}) and (white_is_zero or layout.photometric in (1, 2, 3, 6))
    )


@cache
def _decodes_avif() -> bool:
    """Whether this build of OpenCV was made with a decoder of AVIF."""
    return re.search(r"AVIF:\s+(?!NO)\S", cv2.getBuildInformation()) is not None


class _QuietOpenCV:
    """Keeps OpenCV from writing to stderr about files that we report by an error of our own.

    Its log level is one for the whole process, which is not ours alone: the first of several threads that decode at the
    same time sets it and the last one sets it back, unless somebody else has set another meanwhile.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._n_inside = 0
        self._before = _SILENT

    @contextmanager
    def entered(self) -> Iterator[None]:
        """Be quiet until the last of all that have entered leaves."""
        logging: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 moved the functions
        with self._lock:
            if self._n_inside == 0:
                self._before = logging.setLogLevel(_SILENT)
            self._n_inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._n_inside -= 1
                if self._n_inside == 0 and logging.getLogLevel() == _SILENT:
                    logging.setLogLevel(self._before)


_QUIET_OPENCV = _QuietOpenCV()
