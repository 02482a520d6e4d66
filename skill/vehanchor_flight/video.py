"""Frames of a video as photographs: the sharpest frame of each interval."""

from __future__ import annotations

import math
import os
import threading
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageNotFoundError, ImageTooLargeError
from vehanchor.imagery.limits import check_side
from vehanchor.options import ImageLimits
from vehanchor.options.option import Limits
from vehanchor_flight.inputs import InputPhotograph

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".webm"})
_TRIALS = 5  # frames compared for one photograph
_SHARPNESS_SIDE_PX = 640
_MOV_ATOMS = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot"})
_PACKET_BYTES = 188  # of an MPEG transport stream; cameras put four bytes before each
_HEAD_BYTES = 256
# OpenCV reads FFmpeg's options from the environment only
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_opening = threading.Lock()


def is_video(path: str) -> bool:
    """Tell whether a file name has a video suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def sample_video(
    path: str, every_s: float, limits: ImageLimits | None = None
) -> Iterator[InputPhotograph]:
    """Sample a video at regular intervals.

    The sharpest of five frames of each interval is kept. One frame is held in memory at a time.
    FFmpeg may use only the demuxer of the file's signature, and only this file: a playlist that
    names other files is no video.

    Args:
        path: path of the video.
        every_s: seconds from one photograph to the next.
        limits: ``max_pixels`` bounds the declared frame; None for the defaults. A later, larger
            frame is reduced.

    Yields:
        Photographs, named by the video and their time in seconds.

    Raises:
        ImageNotFoundError: the file does not exist.
        ImageDecodeError: the video cannot be read.
        ImageTooLargeError: a frame has more pixels than the limits allow.
        ImageFormatError: a frame is too small to measure.
        InvalidParameterError: the seconds are not a number above zero.
    """
    step_s = Limits(above=0).check("every", every_s)
    if not Path(path).is_file():
        raise ImageNotFoundError(f"cannot open the video {path!r}: there is no such file")
    with opened_video(path) as film:
        rate = float(film.get(cv2.CAP_PROP_FPS))
        if not 0 < rate < 1e4:
            raise _unreadable(path)
        _check_frame(film, limits or ImageLimits())
        stretch = max(1, round(step_s * rate))
        wanted = {round(k * stretch / _TRIALS) for k in range(_TRIALS)}
        best: tuple[float, int, NDArray[np.uint8]] | None = None
        number = 0
        while film.grab():
            if number % stretch == 0 and best is not None:
                yield _taken(path, best, rate)
                best = None
            if number % stretch in wanted:
                known, frame = film.retrieve()
                if known:
                    seen = np.asarray(frame, dtype=np.uint8)
                    sharp = sharpness(seen)
                    if best is None or sharp > best[0]:
                        best = sharp, number, seen
            number += 1
        if best is not None:
            yield _taken(path, best, rate)
        if number == 0:
            raise ImageDecodeError(f"the video {path!r} has no readable frame")


@contextmanager
def opened_video(path: str) -> Iterator[cv2.VideoCapture]:
    """Open a video with the demuxer of its signature and no protocol but ``file``.

    Raises:
        ImageDecodeError: the video cannot be read.
    """
    demuxer = _demuxer(Path(path))
    if demuxer is None:
        raise _unreadable(path)
    with _opening:
        before = os.environ.get(_OPTIONS)
        os.environ[_OPTIONS] = f"protocol_whitelist;file|format_whitelist;{demuxer}"
        try:
            # a relative path may name a protocol
            film = cv2.VideoCapture(str(Path(path).absolute()), cv2.CAP_FFMPEG)
        finally:
            del os.environ[_OPTIONS]
            if before is not None:
                os.environ[_OPTIONS] = before
    try:
        if not film.isOpened():
            raise _unreadable(path)
        yield film
    finally:
        film.release()


def _demuxer(path: Path) -> str | None:
    """Name FFmpeg's demuxer for a file by its first bytes; None if it is no known video."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise ImageDecodeError(f"cannot read the video {str(path)!r}: {error.strerror}") from error
    if head[4:8] in _MOV_ATOMS:
        return "mov"
    if head.startswith(b"\x1a\x45\xdf\xa3"):
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    packets = ((0, _PACKET_BYTES), (4, 2 * 4 + _PACKET_BYTES))
    return "mpegts" if any(head[i : i + 1] == head[j : j + 1] == b"G" for i, j in packets) else None


def _check_frame(film: cv2.VideoCapture, limits: ImageLimits) -> None:
    width = int(film.get(cv2.CAP_PROP_FRAME_WIDTH))
    height = int(film.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the video declares frames of {width} x {height} px, the limit is "
            f"{limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels)"
        )
    check_side(width, height)


def _unreadable(path: str) -> ImageDecodeError:
    return ImageDecodeError(
        f"the video {path!r} cannot be read: give MP4, MOV, AVI or MKV, or its frames"
    )


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Compute the variance of the Laplacian on a reduced copy, to suppress noise.

    Args:
        frame: ``[h, w, 3]``.
    """
    factor = min(1.0, _SHARPNESS_SIDE_PX / max(frame.shape[:2]))
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_64F).var())


def _taken(path: str, best: tuple[float, int, NDArray[np.uint8]], rate: float) -> InputPhotograph:
    _, number, frame = best
    digits = max(2, math.ceil(math.log10(max(rate, 1.0))))  # unique names
    return InputPhotograph(
        f"{path} at {number / rate:.{digits}f} s", np.ascontiguousarray(frame[:, :, ::-1]), path
    )
