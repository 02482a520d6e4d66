"""Camera facts in the subtitles that DJI's drones write beside a film.

Each entry has the height above take-off and, by the firmware, the focal length, the digital zoom
and the gimbal's angles. Layouts of several firmware versions are read:

* ``[focal_len: 24.00] [dzoom_ratio: 10000, delta:0] [rel_alt: 1.300 abs_alt: 145.2]``
* ``[gb_yaw: 12.3 gb_pitch: -90.0 gb_roll: 0.0]``
* ``GPS(13.8,55.7,16) BAROMETER: 1.9``
* ``F/2.8, SS 206.14, ISO 150, GPS (-122.1, 37.4, 19), D 24.3m, H 6.0m``

``[altitude: ...]`` is not read: some versions mean metres above the sea.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.camera import CameraMetadata

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

# An hour of film at 30 frames per second has 108,000 entries of some 400 bytes. Choices.
_MAX_BYTES = 64 << 20
_MAX_LINE_CHARS = 2000
_MAX_LINES_OF_ENTRY = 20
_MAX_ENTRIES = 200_000
_SUFFIXES = (".SRT", ".srt")
# A film without an entry for so long is beyond its subtitles. A choice.
_MAX_GAP_S = 2.0
# Some versions write tenths of a millimetre and no decimal point; lenses of drones have ten to 99
# millimetres, or a decimal point.
_LEAST_TENTHS = 100
_ZOOM_UNIT = 10_000.0
_LEAST_ZOOM_IN_UNITS = 1000.0

_TIME = re.compile(r"(\d{1,3}):(\d{2}):(\d{2})[,.](\d{3}) *-->")
_NUMBER = r"([-+]?\d{1,9}(?:\.\d{1,9})?)"
# A number that goes on, such as 40,8 or 1.2.3, is not read: its decimals would be lost.
_END = r"(?![\d.]|,\d)"
# A bounded number of blanks keeps the time of a search proportional to the text.
_COLON = r" {0,3}: {0,3}"
_HEIGHTS = {
    "rel_alt": re.compile(rf"\brel_alt{_COLON}{_NUMBER}{_END}"),
    "BAROMETER": re.compile(rf"\bBAROMETER{_COLON}{_NUMBER}{_END}"),
    "H": re.compile(rf"(?:^|[ ,])H[ :]{{0,3}}{_NUMBER} ?m\b(?!/)"),
}
_FOCAL = re.compile(rf"\bfocal_len{_COLON}(\d{{1,5}}(?:\.\d{{1,3}})?){_END}")
_ZOOM = re.compile(rf"\bdzoom_ratio{_COLON}{_NUMBER}{_END}")
_PITCH = re.compile(rf"\b(?:gb|gimbal)_pitch{_COLON}{_NUMBER}{_END}")
_ROLL = re.compile(rf"\b(?:gb|gimbal)_roll{_COLON}{_NUMBER}{_END}")


@dataclass(frozen=True)
class FilmFacts:
    """Camera facts along a film.

    Attributes:
        times_s: seconds from the beginning of the film, rising.
        cameras: the facts from each of these times on.
    """

    times_s: tuple[float, ...]
    cameras: tuple[CameraMetadata, ...]

    def at(self, time_s: float) -> CameraMetadata | None:
        """Find the facts at a time of the film; None before the first and long after the last."""
        index = bisect_right(self.times_s, time_s) - 1
        if index < 0 or time_s - self.times_s[index] > _MAX_GAP_S:
            return None
        return self.cameras[index]


def read_film_facts(film: str, last_s: float = math.inf) -> FilmFacts | None:
    """Read the subtitles beside a film, ``film.SRT`` beside ``film.MP4``.

    Time and memory are bounded: at most 64 MiB and 200,000 entries are read.

    Args:
        film: path of the film.
        last_s: seconds from the beginning after which nothing is read.

    Returns:
        None without subtitles, and without a camera fact in them.
    """
    for suffix in _SUFFIXES:
        path = Path(film).with_suffix(suffix)
        if path.is_file():
            return _film_facts(_lines(path), last_s)
    return None


def _lines(path: Path) -> Iterator[str]:
    """Read the lines of a text file within the limits; none of a file that cannot be read."""
    try:
        with path.open("rb") as file:
            n_bytes = 0
            while n_bytes < _MAX_BYTES:
                line = file.readline(_MAX_LINE_CHARS)
                if not line:
                    return
                n_bytes += len(line)
                yield line.decode("utf-8", "replace").strip()
    except OSError:
        return


def _film_facts(lines: Iterable[str], last_s: float) -> FilmFacts | None:
    """Collect the facts of all entries whose times rise."""
    times_s: list[float] = []
    cameras: list[CameraMetadata] = []
    for time_s, text in _entries(lines):
        if time_s > last_s or len(times_s) >= _MAX_ENTRIES:
            break
        camera = read_camera_facts(text)
        if camera is None or (times_s and time_s <= times_s[-1]):
            continue
        times_s.append(time_s)
        # Equal facts share their memory.
        is_repeated = bool(cameras) and camera == cameras[-1]
        cameras.append(cameras[-1] if is_repeated else camera)
    if not times_s:
        return None
    return FilmFacts(tuple(times_s), tuple(cameras))


def _entries(lines: Iterable[str]) -> Iterator[tuple[float, str]]:
    """Group the lines of subtitles: the time at which each entry begins, and its text."""
    time_s: float | None = None
    text: list[str] = []
    for line in lines:
        match = _TIME.match(line)
        if match is None:
            # The text of a damaged entry is bounded.
            if time_s is not None and len(text) < _MAX_LINES_OF_ENTRY:
                text.append(line)
            continue
        if time_s is not None:
            yield time_s, " ".join(text)
        parts = [int(part) for part in match.groups()]
        hours, minutes, seconds, milliseconds = parts
        time_s = 3600.0 * hours + 60.0 * minutes + seconds + milliseconds / 1000
        text = []
    if time_s is not None:
        yield time_s, " ".join(text)


def read_camera_facts(text: str) -> CameraMetadata | None:
    """Read the camera facts in the text of one entry; None without any."""
    height_m = None
    height_tag = ""
    for name, pattern in _HEIGHTS.items():
        height_m = _number(pattern, text)
        if height_m is not None:
            height_tag = f"subtitle {name}"
            break
    focal_35mm = _focal_35mm(text)
    off_nadir_deg = _off_nadir_deg(text)
    if height_m is None and focal_35mm is None and off_nadir_deg is None:
        return None
    return CameraMetadata(
        height_m=height_m,
        height_tag=height_tag,
        focal_35mm=focal_35mm,
        off_nadir_deg=off_nadir_deg,
        digital_zoom=_digital_zoom(text),
        is_film=True,
    )


def _number(pattern: re.Pattern[str], text: str) -> float | None:
    match = pattern.search(text)
    return None if match is None else float(match[1])


def _focal_35mm(text: str) -> float | None:
    """Read the 35 mm equivalent focal length, millimetres; 240 without a point is 24 mm."""
    match = _FOCAL.search(text)
    if match is None:
        return None
    focal = float(match[1])
    if "." not in match[1] and focal >= _LEAST_TENTHS:
        focal /= 10
    return focal or None


def _digital_zoom(text: str) -> float:
    """Read the digital zoom, 10000 or 1.0 for none; 1 if it is unknown."""
    zoom = _number(_ZOOM, text)
    if zoom is None or zoom <= 0:
        return 1.0
    return zoom / _ZOOM_UNIT if zoom >= _LEAST_ZOOM_IN_UNITS else zoom


def _off_nadir_deg(text: str) -> float | None:
    """Compute the angle from straight down; None if it is unknown.

    The pitch is counted from the horizon, -90 straight down. Pitch and roll of exactly 0 are what
    some drones write for unknown angles.
    """
    pitch_deg = _number(_PITCH, text)
    if pitch_deg is None:
        return None
    if pitch_deg == 0 and not _number(_ROLL, text):
        return None
    from_nadir = math.radians(pitch_deg + 90)
    return math.degrees(math.acos(math.cos(from_nadir)))
