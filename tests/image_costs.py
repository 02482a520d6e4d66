"""Time and memory to open a hostile image, measured in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tests import bombs

__all__ = ["FAMILIES", "Cost", "Family", "cost", "grows_too_fast"]

GENEROUS = 3.0
"""Times that a cost may be above proportion, or above the floors, before the check fails."""

FLOOR_S, FLOOR_MIB = 0.1, 64.0
"""Below them nothing is compared: a process has as much of its own."""

MIB = 1 << 20
_WORK = """
import json, sys, time
from vehanchor.errors import ImageError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.raster import Window

def peak_kib():  # not getrusage: a child inherits its parent's ru_maxrss
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))

data = open(sys.argv[1], "rb").read()
before = peak_kib()
started = time.process_time()
try:
    with open_raster(data) as raster:
        raster.read(Window(0, 0, 16, 16))
    answer = "opened"
except ImageError as error:
    answer = error.code
taken = time.process_time() - started
held = peak_kib() - before
print(json.dumps([taken, held / 1024, answer]))
"""


class Family(NamedTuple):
    """A way to be expensive.

    Attributes:
        make: an image of a size.
        size: the smaller of two, of which the other is four times as large: bytes, scans, chunks or pixels.
        unit: of the size.
    """

    make: Callable[[int], bytes]
    size: int
    unit: str


class Cost(NamedTuple):
    """What opening an image took.

    Attributes:
        seconds: of the processor.
        mebibytes: of memory, above what the process held before.
        answer: ``opened``, or the code of the error.
    """

    seconds: float
    mebibytes: float
    answer: str


def _square(dtype: str, bands: int, rows: int | None) -> Callable[[int], bytes]:
    return lambda n_pixels: bombs.zero_tiff(int(n_pixels**0.5), dtype, bands, rows)


FAMILIES: dict[str, Family] = {
    **{name: Family(make, MIB, "bytes") for name, make in bombs.HEADER_BOMBS.items()},
    "progressive JPEG, 1 megapixel": Family(lambda n_scans: bombs.jpeg_of_scans(n_scans, 1024), 25, "scans"),
    "progressive JPEG, beyond the limit": Family(lambda n_scans: bombs.jpeg_of_scans(n_scans, 1024), 625, "scans"),
    "PNG with zipped texts": Family(bombs.png_of_text, 50, "texts"),
    "TIFF float64 RGBA, strips": Family(_square("float64", 4, 16), 16_000_000, "pixels"),
    "TIFF float64 grey, one strip": Family(_square("float64", 1, None), 16_000_000, "pixels"),
    "TIFF 16-bit RGBA, one strip": Family(_square("uint16", 4, None), 16_000_000, "pixels"),
    "TIFF 8-bit RGB, one strip": Family(_square("uint8", 3, None), 16_000_000, "pixels"),
    "TIFF of two sizes": Family(lambda side_px: bombs.tiff_with_two_sizes(large_px=side_px), 5_000, "pixels a side"),
}


def cost(data: bytes, folder: Path) -> Cost:
    """Open an image in a new process."""
    path = folder / "bomb"
    path.write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", _WORK, str(path)], capture_output=True, text=True, check=True, timeout=120
    )
    return Cost(*json.loads(done.stdout))


def grows_too_fast(small: Cost, large: Cost, factor: int = 4) -> bool:
    """Whether the larger image costs more than in proportion, generously."""
    return large.seconds > GENEROUS * factor * max(
        small.seconds, FLOOR_S / factor
    ) or large.mebibytes > GENEROUS * factor * max(small.mebibytes, FLOOR_MIB / factor)
