"""Frames of a video as photographs: the sharpest frame of each interval."""

from __future__ import annotations

import math
import os
import threading
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.errors import ImageDecodeError, ImageNotFoundError, ImageTooLargeError
from vehanchor.imagery.limits import check_side
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ImageLimits
from vehanchor.options.option import Limits
from vehanchor.options.pixel_grid import MAX_ASPECT, PixelGrid, usable_aspect
from vehanchor_flight.inputs import InputPhotograph
from vehanchor_flight.interlaced import RAW, returns_no_frames
from vehanchor_flight.spherical import MATROSKA_SIGNATURE, stated_projection
from vehanchor_flight.subtitles import read_film_facts

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.subtitles import FilmFacts

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".avi", ".mkv", ".m4v", ".mts", ".m2ts", ".ts", ".webm"}
)
_N_TRIALS = 5  # Frames that are compared for one photograph.
_SHARPNESS_SIDE_PX = 640
_QUARTER_TURN_DEG = 90
_MOV_ATOMS = frozenset({b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot"})
# Each packet of an MPEG transport stream begins with this byte; cameras put four bytes before it.
_PACKET_SYNC = b"G"
_PACKET_BYTES = 188
_CAMERA_PREFIX_BYTES = 4
_HEAD_BYTES = 256
# OpenCV reads FFmpeg's options from the environment only.
_OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_CONVERSION = (
    "convert it, such as by ffmpeg -i FILM -vf yadif -pix_fmt yuv420p progressive.mp4, or give its "
    "frames"
)
_environment_lock = threading.Lock()


class _SharpFrame(NamedTuple):
    """Candidate for a photograph.

    Attributes:
        sharpness: see ``sharpness``.
        number: of the frame in the video.
        pixels: ``[h, w, 3]`` uint8 BGR.
    """

    sharpness: float
    number: int
    pixels: NDArray[np.uint8]


def is_video(path: str) -> bool:
    """Check whether a file name has a video suffix."""
    return Path(path).suffix.lower() in VIDEO_SUFFIXES


def sample_video(
    path: str,
    every_s: float,
    limits: ImageLimits | None = None,
    *,
    first_s: float | None = None,
) -> Iterator[InputPhotograph]:
    """Sample a video at regular intervals.

    The sharpest of five frames of each interval is kept. One frame is held in memory at a time.
    Frames have the size at which they are displayed: square pixels, at least as many as stored.
    FFmpeg may use only the demuxer of the file's signature, and only this file: a playlist that
    names other files is not a video.

    Args:
        path: path of the video.
        every_s: seconds from one photograph to the next.
        limits: ``max_pixels`` bounds the declared frame; None for the defaults. A later, larger
            frame is reduced.
        first_s: seconds from the beginning that are used; None for the whole video.

    Yields:
        Photographs, named by the video and their time in seconds, with the camera facts of DJI's
        subtitles beside the video.

    Raises:
        ImageNotFoundError: the file does not exist.
        ImageDecodeError: the video cannot be read.
        ImageTooLargeError: a frame has more pixels than the limits allow.
        ImageFormatError: a frame is too small to measure.
        InvalidParameterError: the seconds are not a number above zero.
    """
    step_s = Limits(above=0).check("every", every_s)
    last_s = math.inf
    if first_s is not None:
        last_s = Limits(above=0).check("first", first_s)
    if not Path(path).is_file():
        raise ImageNotFoundError(f"cannot open the video {path!r}: there is no such file")
    facts = read_film_facts(path, last_s)
    projection = stated_projection(path)
    with opened_video(path) as film:
        rate = float(film.get(cv2.CAP_PROP_FPS))
        if not 0 < rate < 1e4:
            raise _unreadable(path)
        grid = _checked_grid(film, limits or ImageLimits())
        if _is_unreadable_interlaced(path):
            raise ImageDecodeError(
                f"the video {path!r} is interlaced, and its frames cannot be decoded: {_CONVERSION}"
            )
        interval = max(1, round(step_s * rate))
        trials = {round(trial * interval / _N_TRIALS) for trial in range(_N_TRIALS)}
        sharpest: _SharpFrame | None = None
        number = 0
        n_photographs = 0
        # All frames are grabbed one after the other; only the trials are converted to pixels.
        while number / rate < last_s and film.grab():
            position = number % interval
            if position == 0 and sharpest is not None:
                n_photographs += 1
                yield _photograph(path, sharpest, rate=rate, facts=facts, projection=projection)
                sharpest = None
            if position in trials:
                candidate = _retrieve(film, number, grid)
                sharpest = _sharper(sharpest, candidate)
            number += 1
        if sharpest is not None:
            n_photographs += 1
            yield _photograph(path, sharpest, rate=rate, facts=facts, projection=projection)
        if number == 0:
            raise ImageDecodeError(
                f"the video {path!r} has no frame that can be decoded here, such as in AV1: "
                f"{_CONVERSION}"
            )
        if n_photographs == 0:
            raise ImageDecodeError(
                f"the frames of the video {path!r} are of one colour each, or damaged: "
                f"{_CONVERSION}"
            )


def _sharper(
    first: _SharpFrame | None,
    second: _SharpFrame | None,
) -> _SharpFrame | None:
    """Return the sharper of two frames; the first of equals, and the other one for None."""
    if first is None:
        return second
    if second is None or second.sharpness <= first.sharpness:
        return first
    return second


def _retrieve(film: cv2.VideoCapture, number: int, grid: PixelGrid) -> _SharpFrame | None:
    """Convert the frame that was grabbed last to square pixels.

    Returns:
        The frame; None if it is damaged or of one colour.
    """
    is_readable, frame = film.retrieve()
    if not is_readable:
        return None
    pixels = np.asarray(frame, dtype=np.uint8)
    if pixels.min() == pixels.max():
        return None
    if not grid.is_square:
        display_size = (grid.square_width_px, grid.square_height_px)
        resized = cv2.resize(pixels, display_size, interpolation=cv2.INTER_LINEAR)
        pixels = np.asarray(resized, dtype=np.uint8)
    return _SharpFrame(sharpness(pixels), number, pixels)


def _photograph(
    path: str,
    frame: _SharpFrame,
    *,
    rate: float,
    facts: FilmFacts | None,
    projection: str,
) -> InputPhotograph:
    """Make a photograph of a frame, in RGB, named by the video and its time.

    Args:
        path: path of the video.
        frame: the frame.
        rate: frames per second.
        facts: camera facts along the video; None without any.
        projection: what states that its frames are not perspective views; empty if nothing does.
    """
    # As many digits as give each frame another name.
    magnitude = math.log10(max(rate, 1.0))
    digits = max(2, math.ceil(magnitude))
    seconds = frame.number / rate
    name = f"{path} at {seconds:.{digits}f} s"
    # OpenCV gives blue first.
    rgb = np.ascontiguousarray(frame.pixels[:, :, ::-1])
    camera = None if facts is None else facts.at(seconds)
    if projection:
        camera = replace(camera or CameraMetadata(is_film=True), projection=projection)
    return InputPhotograph(name, rgb, film=path, camera=camera)


def _is_unreadable_interlaced(path: str) -> bool:
    """Test whether OpenCV cannot convert the frames of an interlaced film."""
    with opened_video(path) as film, opened_video(path, RAW) as raw_film:
        return returns_no_frames(film, raw_film)


@contextmanager
def opened_video(path: str, parameters: Sequence[int] = ()) -> Iterator[cv2.VideoCapture]:
    """Open a video with the demuxer of its signature and no protocol but ``file``.

    Args:
        path: path of the video.
        parameters: of ``cv2.VideoCapture``.

    Raises:
        ImageDecodeError: the video cannot be read.
    """
    demuxer = _demuxer(Path(path))
    if demuxer is None:
        raise _unreadable(path)
    # The environment belongs to the process: one thread at a time may change it.
    with _environment_lock:
        before = os.environ.get(_OPTIONS)
        os.environ[_OPTIONS] = f"protocol_whitelist;file|format_whitelist;{demuxer}"
        try:
            # A relative path may name a protocol.
            absolute_path = str(Path(path).absolute())
            film = cv2.VideoCapture(absolute_path, cv2.CAP_FFMPEG, list(parameters))
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
    """Name FFmpeg's demuxer for a file by its first bytes; None for an unknown format."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise ImageDecodeError(f"cannot read the video {str(path)!r}: {error.strerror}") from error
    if head[4:8] in _MOV_ATOMS:
        return "mov"
    if head.startswith(MATROSKA_SIGNATURE):
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    if _is_transport_stream(head) or _is_transport_stream(head, _CAMERA_PREFIX_BYTES):
        return "mpegts"
    return None


def _is_transport_stream(head: bytes, prefix: int = 0) -> bool:
    """Check whether two packets of MPEG-TS follow each other, each after ``prefix`` bytes."""
    second = prefix + _PACKET_BYTES + prefix
    # Slices are empty beyond the end of a short file, where an index would fail.
    first_byte = head[prefix : prefix + 1]
    second_byte = head[second : second + 1]
    return first_byte == second_byte == _PACKET_SYNC


def _checked_grid(film: cv2.VideoCapture, limits: ImageLimits) -> PixelGrid:
    """Check the declared size of the frames, as stored and as displayed, before one is decoded.

    An anamorphic film is displayed in square pixels; its sample aspect ratio is their stored width
    over their height.
    """
    width = int(film.get(cv2.CAP_PROP_FRAME_WIDTH))
    height = int(film.get(cv2.CAP_PROP_FRAME_HEIGHT))
    _check_frame(width, height, limits)
    grid = PixelGrid(width, height, _pixel_aspect(film))
    _check_frame(grid.square_width_px, grid.square_height_px, limits)
    return grid


def _check_frame(width: int, height: int, limits: ImageLimits) -> None:
    """Check the size of a frame."""
    if width * height > limits.max_pixels:
        raise ImageTooLargeError(
            f"the video declares frames of {width} x {height} px, the limit is "
            f"{limits.max_pixels} pixels (--max-megapixels, ImageLimits.max_pixels)"
        )
    check_side(width, height)


def _pixel_aspect(film: cv2.VideoCapture) -> float:
    """Read the height of a frame's pixel over its width; 1 if it is unknown or absurd.

    The sample aspect ratio is that of the stored frame, which OpenCV turns as the file asks for.
    """
    across = film.get(cv2.CAP_PROP_SAR_NUM)
    down = film.get(cv2.CAP_PROP_SAR_DEN)
    if across <= 0 or down <= 0:
        return 1.0
    aspect = down / across
    is_turned = film.get(cv2.CAP_PROP_ORIENTATION_META) % 180 == _QUARTER_TURN_DEG
    if is_turned and film.get(cv2.CAP_PROP_ORIENTATION_AUTO):
        aspect = 1 / aspect
    if not 1 / MAX_ASPECT <= aspect <= MAX_ASPECT:
        return 1.0
    return usable_aspect(aspect)


def _unreadable(path: str) -> ImageDecodeError:
    return ImageDecodeError(
        f"the video {path!r} cannot be read: give MP4, MOV, AVI or MKV, or its frames"
    )


def sharpness(frame: NDArray[np.uint8]) -> float:
    """Compute the variance of the Laplacian on a reduced copy, to suppress noise.

    Args:
        frame: ``[h, w, 3]``.
    """
    height, width, _ = frame.shape
    longer_px = max(height, width)
    factor = min(1.0, _SHARPNESS_SIDE_PX / longer_px)
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    laplacian = cv2.Laplacian(grey, cv2.CV_64F)
    return float(laplacian.var())
