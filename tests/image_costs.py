"""Time and memory to open a hostile image, measured in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tests import bombs

__all__ = ["FAMILIES", "FORMATS", "Cost", "Family", "cost", "grows_too_fast"]

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


def _tiff_of_shared_tags(n_bytes: int) -> bytes:
    """4,000 unknown tags, all with the same bytes."""
    entries = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 8), (262, 3, 1, 1)]
    shared = [(tag, 1, n_bytes - 60_000, 50_000) for tag in range(40_000, 44_000)]
    return bombs.tiff_of_directory([*entries, *shared], after=bytes(n_bytes - 12 * 4004 - 14))


FAMILIES["TIFF of shared tags"] = Family(_tiff_of_shared_tags, 1 << 18, "bytes")


def _noise(side_px: int, bands: int, dtype: str = "uint8") -> NDArray[Any]:
    """Smooth noise, which every format compresses somewhat; alpha is neither 0 nor 255 all over."""
    coarse = np.random.default_rng(1).integers(1, 255, (side_px // 8, side_px // 8, bands), dtype=np.uint8)
    fine = cv2.resize(coarse, (side_px, side_px), interpolation=cv2.INTER_LINEAR).reshape(side_px, side_px, bands)
    return fine.astype(dtype) * (1 if dtype == "uint8" else 4)


def _encoded(suffix: str, bands: int, dtype: str = "uint8", *parameters: int) -> Callable[[int], bytes]:
    return lambda side_px: cv2.imencode(suffix, _noise(side_px, bands, dtype), parameters)[1].tobytes()


_FAST_AVIF = cv2.IMWRITE_AVIF_SPEED, 10
_DEEP_AVIF = *_FAST_AVIF, cv2.IMWRITE_AVIF_DEPTH, 10
FORMATS: dict[str, Callable[[int], bytes]] = {
    "JPEG": _encoded(".jpg", 3),
    "JPEG, grey": _encoded(".jpg", 1),
    "JPEG, progressive": _encoded(".jpg", 3, "uint8", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "PNG": _encoded(".png", 3),
    "PNG with alpha": _encoded(".png", 4),
    "PNG, grey": _encoded(".png", 1),
    "PNG, 16 bits": _encoded(".png", 3, "uint16"),
    "WebP": _encoded(".webp", 3, "uint8", cv2.IMWRITE_WEBP_QUALITY, 60),
    "WebP, lossless": _encoded(".webp", 3, "uint8", cv2.IMWRITE_WEBP_QUALITY, 101),
    "WebP with alpha": _encoded(".webp", 4, "uint8", cv2.IMWRITE_WEBP_QUALITY, 60),
    "AVIF": _encoded(".avif", 3, "uint8", *_FAST_AVIF),
    "AVIF, lossless": _encoded(".avif", 3, "uint8", *_FAST_AVIF, cv2.IMWRITE_AVIF_QUALITY, 100),
    "AVIF with alpha": _encoded(".avif", 4, "uint8", *_FAST_AVIF),
    "AVIF, 10 bits": _encoded(".avif", 3, "uint16", *_DEEP_AVIF),
    "AVIF with alpha, 10 bits": _encoded(".avif", 4, "uint16", *_DEEP_AVIF),
    "BMP": _encoded(".bmp", 3),
    "BMP with alpha": _encoded(".bmp", 4),
    "TIFF in strips": _encoded(".tif", 3),
    "TIFF in strips, 16 bits": _encoded(".tif", 3, "uint16"),
    "TIFF in strips, floats": _encoded(".tif", 3, "float32"),
    "TIFF of one strip": lambda side_px: bombs.one_strip_tiff(_noise(side_px, 3)),
    "TIFF of one strip with alpha": lambda side_px: bombs.one_strip_tiff(_noise(side_px, 4)),
    "TIFF of one strip, grey": lambda side_px: bombs.one_strip_tiff(_noise(side_px, 1)[..., 0]),
    "TIFF of one strip, 16 bits": lambda side_px: bombs.zero_tiff(side_px, "uint16", 3),
}
"""Honest images of every format that is decoded whole, by their sides in pixels."""


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
