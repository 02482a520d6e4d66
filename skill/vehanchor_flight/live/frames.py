"""Frames of a running camera: a folder that fills. The newest frame wins: no queue grows."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageError, ImageNotFoundError
from vehanchor.imagery.sources.files import SUFFIXES
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options.option import Limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.options import Reading

_POLL_S = 0.05
_IDLE_S = Limits(above=0, most=3600)


class Frame(NamedTuple):
    """One frame.

    Attributes:
        name: the file.
        image: ``[h, w, 3]`` uint8 RGB.
        at_s: its arrival by ``time.monotonic``, seconds.
        n_skipped: number of frames since the last one that this one replaced.
    """

    name: str
    image: NDArray[np.uint8]
    at_s: float
    n_skipped: int


def open_frames(
    folder: Path, reading: Reading, *, idle_s: float | None, tell: Callable[[str], None]
) -> Iterator[Frame]:
    """Check the arguments before the first frame, and watch a folder as ``folder_frames`` does.

    Raises:
        ImageNotFoundError: there is no such folder.
        InvalidParameterError: the seconds are invalid.
    """
    if idle_s is not None:
        _IDLE_S.check("idle", idle_s)
    if not folder.is_dir():
        raise ImageNotFoundError(
            f"{str(folder)!r} is no folder: name the folder into which a program writes the camera's frames"
        )
    return folder_frames(folder, reading, idle_s=idle_s, tell=tell)


def folder_frames(
    folder: Path, reading: Reading, *, idle_s: float | None, tell: Callable[[str], None]
) -> Iterator[Frame]:
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
        ready = [name for name, state in now.items() if before.get(name) == state and taken.get(name) != state]
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
                with open_raster(path, bands=reading.bands, limits=reading.limits, bgr=reading.bgr) as raster:
                    image = raster.read()
            except ImageError as error:
                tell(f"{name}: {error}")
                continue
            yield Frame(str(path), image, arrived, len(ready) - older)
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
