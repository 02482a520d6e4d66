"""Frames of a running camera, a folder that fills, or a video. The newest frame wins: no queue grows.

A source yields frames when it is asked for one, and counts those that newer ones replaced. Only a
video gives every frame of its interval, however long each one takes.
"""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

import cv2
import numpy as np

from vehanchor.errors import ImageError, ImageNotFoundError, InvalidParameterError
from vehanchor.imagery.sources.files import SUFFIXES
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options.option import Limits
from vehanchor_flight.video import is_video, sample_video

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator

    from numpy.typing import NDArray

    from vehanchor.options import Reading

_POLL_S = 0.05
_RETRY_S = 1.0  # until a lost camera is tried again
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
    image: NDArray[np.uint8]
    at_s: float
    arrived_s: float
    n_skipped: int


class Camera(Protocol):
    """The part of ``cv2.VideoCapture`` that a camera needs."""

    def read(self) -> tuple[bool, NDArray[np.uint8]]:
        """Wait for the next frame: whether there is one, and ``[h, w, 3]`` BGR."""
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
    tell: Callable[[str], None],
) -> Iterator[Frame]:
    """Open a source of frames.

    Args:
        source: a folder, a video file, or the number of a camera.
        reading: how to read the images of a folder; its limits hold for a video, too.
        every_s: seconds between the frames of a video.
        idle_s: seconds without a new frame that end a folder or a camera; None for never.
        tell: receives a sentence on each frame that cannot be read, and on each loss and return of
            the camera.

    Returns:
        The frames.

    Raises:
        ImageNotFoundError: the source is neither a folder, nor a video, nor a number.
        InvalidParameterError: the seconds are invalid.
    """
    EVERY_S.check("every", every_s)
    if idle_s is not None:
        EVERY_S.check("idle", idle_s)
    if source.isdecimal():
        return camera_frames(
            lambda: _open_camera(int(source)), f"camera {int(source)}", idle_s=idle_s, tell=tell
        )
    if source and Path(source).is_dir():
        return folder_frames(Path(source), reading, idle_s=idle_s, tell=tell)
    if is_video(source):
        return (
            Frame(
                taken.name, np.asarray(taken.image, np.uint8), number * every_s, time.monotonic(), 0
            )
            for number, taken in enumerate(sample_video(source, every_s, reading.limits))
        )
    raise ImageNotFoundError(
        f"{source!r} is no source of frames: name a folder, a video, or the number of a camera"
    )


def folder_frames(
    folder: Path,
    reading: Reading,
    *,
    idle_s: float | None = None,
    tell: Callable[[str], None] = print,
) -> Generator[Frame, None, None]:
    """Watch a folder by polling, and yield its newest readable image whenever one was added or replaced.

    A file counts when its size and time are the same at two polls: then it is written completely.

    Args:
        folder: the folder; its own files count, those of its folders do not.
        reading: how to read the images.
        idle_s: seconds without a new image that end the source; None for never.
        tell: receives a sentence on each image that cannot be read.
    """
    taken: dict[str, tuple[int, int]] = {}
    before: dict[str, tuple[int, int]] = {}
    last = time.monotonic()
    while idle_s is None or time.monotonic() - last < idle_s:
        now = _listing(folder)
        ready = [
            name
            for name, state in now.items()
            if before.get(name) == state and taken.get(name) != state
        ]
        taken = {name: state for name, state in taken.items() if name in now}
        before = now
        if not ready:
            time.sleep(_POLL_S)
            continue
        taken.update((name, now[name]) for name in ready)
        last = arrived = time.monotonic()
        ready.sort(key=lambda name: (now[name], name), reverse=True)
        for older, name in enumerate(ready, start=1):
            try:
                path = folder / name
                with open_raster(path, reading) as raster:
                    image = raster.read()
            except ImageError as error:
                tell(f"{name}: {error}")
                continue
            yield Frame(str(path), image, arrived, arrived, len(ready) - older)
            break


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """List the images of a folder with their times and sizes; empty while the folder is missing."""
    found = {}
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if Path(entry.name).suffix.lower() in SUFFIXES and entry.is_file():
                    state = entry.stat()
                    found[entry.name] = state.st_mtime_ns, state.st_size
    except OSError:  # a file or the folder was removed meanwhile: the next poll sees the rest
        return found
    return found


def camera_frames(
    open_camera: Callable[[], Camera | None],
    name: str,
    *,
    idle_s: float | None = None,
    tell: Callable[[str], None] = print,
) -> Generator[Frame, None, None]:
    """Yield the newest frame of a camera; a thread reads it without a pause.

    Args:
        open_camera: opens the camera; None if it cannot be opened now. It is called again after
            each loss.
        name: of the camera.
        idle_s: seconds without a frame that end the source; None for never.
        tell: receives a sentence on each loss and return.
    """
    newest = _Newest(open_camera, name, tell)
    try:
        while (frame := newest.take(idle_s)) is not None:
            yield frame
    finally:
        newest.close()


class _Newest:
    """The newest frame of a camera, in one place that each frame overwrites."""

    def __init__(
        self, open_camera: Callable[[], Camera | None], name: str, tell: Callable[[str], None]
    ) -> None:
        self._open = open_camera
        self._name = name
        self._tell = tell
        self._frame: Frame | None = None
        self._changed = threading.Condition()
        self._ended = threading.Event()
        threading.Thread(target=self._run, name=f"{name} of vehanchor live", daemon=True).start()

    def take(self, patience_s: float | None) -> Frame | None:
        """Wait for a frame; None if none came in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._frame is not None, patience_s)
            frame = self._frame
            self._frame = None
        return frame

    def close(self) -> None:
        """End the thread after its current frame."""
        self._ended.set()

    def _run(self) -> None:
        lost = False
        while not self._ended.is_set():
            camera = self._open()
            if camera is not None:
                if self._read(camera, returned=lost):
                    lost = False
                camera.release()
            if not self._ended.is_set():
                if not lost:
                    self._tell(f"{self._name} gives no frames: it is tried again every second")
                lost = True
                self._ended.wait(_RETRY_S)

    def _read(self, camera: Camera, *, returned: bool) -> bool:
        """Read frames until the camera fails; tell whether there was any."""
        number = 0
        while not self._ended.is_set():
            known, pixels = camera.read()
            if not known:
                break
            if returned and number == 0:
                self._tell(f"{self._name} gives frames again")
            number += 1
            now = time.monotonic()
            image = np.ascontiguousarray(np.asarray(pixels, np.uint8)[:, :, ::-1])
            with self._changed:
                skipped = 0 if self._frame is None else self._frame.n_skipped + 1
                self._frame = Frame(f"{self._name} at {now:.2f} s", image, now, now, skipped)
                self._changed.notify()
        return number > 0


def _open_camera(number: int) -> Camera | None:
    if number > 99:
        raise InvalidParameterError(f"the camera {number} does not exist: use 0 for the first")
    camera = cv2.VideoCapture(number)
    if camera.isOpened():
        return camera  # type: ignore[return-value] # the stubs of OpenCV are wider than what it returns
    camera.release()
    return None
