"""Frames of a running camera, a folder that fills, or a video.

The newest frame wins, so that no queue grows. A source yields a frame on demand, and counts those
that newer ones replaced. Only a video gives a frame for every interval, however long each takes.
"""

from __future__ import annotations

import os
import threading
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

import cv2
import numpy as np

from vehanchor.errors import ImageError, ImageNotFoundError, InvalidParameterError
from vehanchor.imagery.formats.header import SUFFIXES
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options.option import Limits
from vehanchor_flight.video import is_video, sample_video

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator, Mapping

    from numpy.typing import NDArray

    from vehanchor.options import Reading

    Picture: TypeAlias = NDArray[np.uint8]
    """Picture ``[h, w, 3]``."""

    OpenCamera: TypeAlias = Callable[[], "Camera | None"]
    """Opens a camera; None if it cannot be opened now."""

    Tell: TypeAlias = Callable[[str], None]
    """Receives a sentence about a frame or a camera."""

_POLL_S = 0.05
_RETRY_S = 1.0  # Until a lost camera is tried again.
_FIRST_TRIALS = 3  # of a camera that never gave a frame; a choice
_MAX_CAMERA_NUMBER = 99
_FileState: TypeAlias = tuple[int, int]
"""Time of the last change in nanoseconds, and size in bytes."""
EVERY_S = Limits(above=0, most=3600)
"""Limits of the seconds between the frames of a video."""


class Frame(NamedTuple):
    """One frame.

    Attributes:
        name: the file, or the source with its time.
        image: ``[h, w, 3]`` uint8 RGB.
        at_s: its time, seconds; only differences have a meaning.
        arrived_s: ``time.monotonic`` at its arrival.
        n_skipped: number of frames since the last one that this one replaced.
    """

    name: str
    image: Picture
    at_s: float
    arrived_s: float
    n_skipped: int


class Camera(Protocol):
    """The part of ``cv2.VideoCapture`` that a camera needs."""

    def read(self) -> tuple[bool, Picture]:
        """Wait for the next frame; return whether there is one, and ``[h, w, 3]`` BGR."""
        ...

    def release(self) -> None:
        """Close the camera."""
        ...


def open_frames(
    source: str,
    reading: Reading,
    *,
    every_s: float,
    idle_s: float | None,
    tell: Tell,
) -> Iterator[Frame]:
    """Open a source of frames.

    Args:
        source: a folder, a video file, or the number of a camera.
        reading: how to read the images of a folder; its limits hold for a video, too.
        every_s: seconds between the frames of a video.
        idle_s: seconds without a new frame that end a folder or a camera; None for never.
        tell: receives a sentence about each frame that cannot be read, and about each loss and
            return of the camera.

    Returns:
        The frames.

    Raises:
        ImageNotFoundError: the source is neither a folder, nor a video, nor a number.
        InvalidParameterError: the seconds are invalid, or no camera can have the number.
    """
    EVERY_S.check("every", every_s)
    if idle_s is not None:
        EVERY_S.check("idle", idle_s)
    if source.isdecimal():
        number = _camera_number(source)
        open_camera = partial(_open_camera, number)
        return camera_frames(open_camera, f"camera {number}", idle_s=idle_s, tell=tell)
    if source and Path(source).is_dir():
        return folder_frames(Path(source), reading, idle_s=idle_s, tell=tell)
    if is_video(source):
        return _video_frames(source, reading, every_s)
    raise ImageNotFoundError(
        f"{source!r} is not a source of frames: name a folder, a video, or the number of a camera"
    )


def _video_frames(path: str, reading: Reading, every_s: float) -> Iterator[Frame]:
    """Yield a frame of a video for each interval; their times are those of the intervals."""
    for number, photograph in enumerate(sample_video(path, every_s, reading.limits)):
        image = np.asarray(photograph.image, np.uint8)
        yield Frame(
            photograph.name,
            image,
            at_s=number * every_s,
            arrived_s=time.monotonic(),
            n_skipped=0,
        )


def folder_frames(
    folder: Path,
    reading: Reading,
    *,
    idle_s: float | None = None,
    tell: Tell = print,
) -> Generator[Frame, None, None]:
    """Watch a folder by polling, and yield its newest readable image after each change.

    A file counts when its size and time are the same at two polls: then it is written completely.

    Args:
        folder: the folder; its own files count, those of its folders do not.
        reading: how to read the images.
        idle_s: seconds without a new image that end the source; None for never. A file that is
            still being written is waited for.
        tell: receives a sentence about each image that cannot be read, and about those that lie
            there before the first frame.
    """
    yielded: dict[str, _FileState] = {}
    before: dict[str, _FileState] = {}
    last_s = time.monotonic()
    while True:
        now = _listing(folder)
        has_changed = now != before
        new = {
            name: state
            for name, state in now.items()
            if before.get(name) == state and yielded.get(name) != state
        }
        # A file that was removed may come back.
        yielded = {name: state for name, state in yielded.items() if name in now}
        before = now
        if not new:
            # On a busy machine the idle time can pass before two polls have seen a file.
            is_idle = idle_s is not None and time.monotonic() - last_s >= idle_s
            if is_idle and not has_changed:
                return
            time.sleep(_POLL_S)
            continue
        if not yielded and len(new) > 1:
            tell(
                f"{folder} has {len(new)} photographs: the newest one counts, and further ones as "
                f"they arrive. 'vehanchor flight {folder}' estimates all"
            )
        # All new files count as yielded, because the newest replaces the older ones.
        yielded |= new
        last_s = time.monotonic()
        frame = _newest_readable(folder, new, reading=reading, arrived_s=last_s, tell=tell)
        if frame is not None:
            yield frame


def _newest_readable(
    folder: Path,
    states: Mapping[str, _FileState],
    *,
    reading: Reading,
    arrived_s: float,
    tell: Tell,
) -> Frame | None:
    """Read the newest readable image of a folder; None without one.

    Args:
        folder: the folder.
        states: the new files, by name.
        reading: how to read the images.
        arrived_s: when they were found.
        tell: receives a sentence about each newer image that cannot be read.
    """

    def age(name: str) -> tuple[_FileState, str]:
        return states[name], name

    newest_first = sorted(states, key=age, reverse=True)
    for rank, name in enumerate(newest_first, start=1):
        path = folder / name
        try:
            with open_raster(path, reading) as raster:
                image = raster.read()
        except ImageError as error:
            tell(f"{name}: {error}")
            continue
        n_older = len(newest_first) - rank
        return Frame(str(path), image, at_s=arrived_s, arrived_s=arrived_s, n_skipped=n_older)
    return None


def _listing(folder: Path) -> dict[str, _FileState]:
    """List the images of a folder with their times and sizes; empty while the folder is missing."""
    states = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                suffix = Path(entry.name).suffix.lower()
                if suffix in SUFFIXES and entry.is_file():
                    facts = entry.stat()
                    states[entry.name] = (facts.st_mtime_ns, facts.st_size)
    except OSError:
        # A file or the folder was removed meanwhile: the next poll sees the rest.
        return states
    return states


def camera_frames(
    open_camera: OpenCamera,
    name: str,
    *,
    idle_s: float | None = None,
    tell: Tell = print,
) -> Generator[Frame, None, None]:
    """Yield the newest frame of a camera; a thread reads the camera without a pause.

    Args:
        open_camera: opens the camera; None if it cannot be opened now. It is called again after
            each loss.
        name: of the camera.
        idle_s: seconds without a frame that end the source; None for never.
        tell: receives a sentence about each loss and return.
    """
    newest = _Newest(open_camera, name, tell)
    try:
        frame = newest.take(idle_s)
        while frame is not None:
            yield frame
            frame = newest.take(idle_s)
    finally:
        newest.close()


class _Newest:
    """The newest frame of a camera, in one place that each frame overwrites."""

    def __init__(
        self,
        open_camera: OpenCamera,
        name: str,
        tell: Tell,
    ) -> None:
        self._open = open_camera
        self._name = name
        self._tell = tell
        self._frame: Frame | None = None
        self._error: Exception | None = None
        self._changed = threading.Condition()
        self._ended = threading.Event()
        thread_name = f"{name} of vehanchor live"
        thread = threading.Thread(target=self._run, name=thread_name, daemon=True)
        thread.start()

    def take(self, patience_s: float | None) -> Frame | None:
        """Wait for a frame; None if none came in time.

        Raises:
            ImageNotFoundError: the camera never gave a frame.
            Exception: another error ended the thread.
        """
        with self._changed:
            self._changed.wait_for(self._has_news, patience_s)
            frame = self._frame
            self._frame = None
        if frame is None and self._error is not None:
            raise self._error
        return frame

    def _has_news(self) -> bool:
        """Test whether there is a frame, or none will come."""
        return self._frame is not None or self._error is not None

    def close(self) -> None:
        """End the thread after its current frame."""
        self._ended.set()

    def _run(self) -> None:
        """Read the camera until the end; pass an error on to ``take``."""
        try:
            self._read_and_reopen()
        except Exception as error:
            # Without this, a caller without a limit of patience would wait for ever.
            with self._changed:
                self._error = error
                self._changed.notify()

    def _read_and_reopen(self) -> None:
        """Read the camera; after each loss, open it again.

        Raises:
            ImageNotFoundError: it never gave a frame.
        """
        is_lost = False
        has_given_frames = False
        n_trials = 0
        while not self._ended.is_set():
            camera = self._open()
            if camera is not None:
                gave_frames = self._read(camera, returned=is_lost)
                if gave_frames:
                    is_lost = False
                    has_given_frames = True
                camera.release()
            if self._ended.is_set():
                break
            n_trials += 1
            if not has_given_frames and n_trials == _FIRST_TRIALS:
                raise ImageNotFoundError(
                    f"{self._name} gives no frames: connect it, use the number of another camera, "
                    "or name a folder or a video"
                )
            # One sentence for each loss, not one for each trial.
            if has_given_frames and not is_lost:
                self._tell(f"{self._name} gives no frames: it is tried again every second")
            is_lost = True
            self._ended.wait(_RETRY_S)

    def _read(self, camera: Camera, *, returned: bool) -> bool:
        """Read frames until the camera fails; return whether it gave any.

        Args:
            camera: open.
            returned: whether it was lost before.
        """
        n_frames = 0
        while not self._ended.is_set():
            is_frame, pixels = camera.read()
            if not is_frame:
                break
            if returned and n_frames == 0:
                self._tell(f"{self._name} gives frames again")
            n_frames += 1
            self._replace(pixels)
        return n_frames > 0

    def _replace(self, pixels: Picture) -> None:
        """Replace the frame by a newer one, and count it if nobody has taken it.

        Args:
            pixels: ``[h, w, 3]`` BGR.
        """
        now_s = time.monotonic()
        # OpenCV gives blue first.
        bgr = np.asarray(pixels, np.uint8)
        image = np.ascontiguousarray(bgr[:, :, ::-1])
        with self._changed:
            n_skipped = 0
            if self._frame is not None:
                n_skipped = self._frame.n_skipped + 1
            self._frame = Frame(
                f"{self._name} at {now_s:.2f} s",
                image,
                at_s=now_s,
                arrived_s=now_s,
                n_skipped=n_skipped,
            )
            self._changed.notify()


def _camera_number(digits: str) -> int:
    """Read the number of a camera.

    The check comes before the thread that reads the camera, because its errors reach nobody.

    Raises:
        InvalidParameterError: no camera can have the number.
    """
    significant = digits.lstrip("0")
    # Python refuses to convert thousands of digits, so their number is checked first.
    max_digits = len(str(_MAX_CAMERA_NUMBER))
    if len(significant) > max_digits:
        raise InvalidParameterError(f"the camera {digits[:20]} does not exist: use 0 for the first")
    return int(significant or "0")


def _open_camera(number: int) -> Camera | None:
    """Open the camera of that number; None if it gives no frames now."""
    camera = cv2.VideoCapture(number)
    if camera.isOpened():
        # The stubs of OpenCV are wider than what it returns.
        return camera  # type: ignore[return-value]
    camera.release()
    return None
