"""Frames of a video as photographs: the sharpest frame of each interval."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageNotFoundError
from vehanchor.flight.inputs import InputPhotograph
from vehanchor.options.option import Limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".webm"})
_TRIALS = 5  # frames compared for one photograph
_SHARPNESS_SIDE_PX = 640


def is_video(path: str) -> bool:
    """Tell whether a file name has a video suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def sample_video(path: str, every_s: float) -> Iterator[InputPhotograph]:
    """Sample a video at regular intervals.

    The sharpest of five frames of each interval is kept. One frame is held in memory at a time.

    Args:
        path: path of the video.
        every_s: seconds from one photograph to the next.

    Yields:
        Photographs, named by the video and their time in seconds.

    Raises:
        ImageNotFoundError: the file does not exist.
        ImageDecodeError: the video cannot be read.
        InvalidParameterError: the seconds are not a number above zero.
    """
    step_s = Limits(above=0).check("every", every_s)
    if not Path(path).is_file():
        raise ImageNotFoundError(f"cannot open the video {path!r}: there is no such file")
    film = cv2.VideoCapture(path)
    try:
        rate = float(film.get(cv2.CAP_PROP_FPS))
        if not film.isOpened() or not 0 < rate < 1e4:
            raise ImageDecodeError(f"the video {path!r} cannot be read: give MP4, MOV, AVI or MKV, or its frames")
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
    finally:
        film.release()


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
    return InputPhotograph(f"{path} at {number / rate:.{digits}f} s", np.ascontiguousarray(frame[:, :, ::-1]), path)
