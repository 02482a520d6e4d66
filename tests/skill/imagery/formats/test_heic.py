"""HEIC is read through libheif: upright, and whole or not at all.

Too large an image is refused by its declared size, before decoding.

No encoder of HEVC is free of the GPL, so the picture is here as pillow-heif encoded it once. It has
64 x 48 px: the upper left quarter is white, the upper right quarter black, the lower half green.
Its container turns it to the right.
"""

from __future__ import annotations

import base64
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehanchor
from vehanchor.errors import ImageDecodeError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

HEIC = base64.b64decode(
    "AAAAHGZ0eXBoZWl4AAAAAG1pZjFoZWl4bWlhZgAAAcltZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAA"
    "AAAAAAAAADRpbG9jAAAAAERAAAIAAQAAAAAB7QABAAAAAAAAAMQAAgAAAAACsQABAAAAAAAAACQAAAA4aWluZgAAAAAA"
    "AgAAABVpbmZlAgAAAAABAABodmMxAAAAABVpbmZlAgAAAQACAABFeGlmAAAAAA5waXRtAAAAAAABAAABCGlwcnAAAADn"
    "aXBjbwAAAHdodmNDAQQIAAAAnjgAAAAAHvAA/P/4+AAADwNgAAEAF0ABDAH//wQIAAADAJ44AAADAAAeugJAYQABACpC"
    "AQEECAAAAwCeOAAAAwAAHpAEECCy3VyU1zcBDQYEAAADAGQAAAMABCBiAAEACEQBwXMYMAiQAAAAE2NvbHJuY2x4AAEA"
    "DQAGgAAAABRpc3BlAAAAAAAAAEAAAABAAAAAKGNsYXAAAABAAAAAAQAAADAAAAABAAAAAAAAAAL////wAAAAAgAAABBw"
    "aXhpAAAAAAMICAgAAAAJaXJvdAMAAAAZaXBtYQAAAAAAAAABAAEGgQIDBYSGAAAAGmlyZWYAAAAAAAAADmNkc2MAAgAB"
    "AAEAAADwbWRhdAAAAMAoAa8GOFtj5Wb/Su5JaK3xpPa5v+cNv//6XD//7SlxVQ3/u7Ur4I++nH7Y/03+agIZ/3dqV8Ef"
    "fTj9sf6b/NX/zRnlDEjFJYob8WXUaP3S/3n772ztftfM0IQ1xhBKfsX+i6xQ/0FrxtrkEE2Vcp1C8EU0Kldd5xz/hCkE"
    "ekIv/7X/vr/74sH5Y3aVPWZPL26irBJPr88ZBD6e227FRktwW7KmA5R8Atn2YtenfFfI3a2+Pvg1ehkS+Il9d83kFrsA"
    "AAAGRXhpZgAATU0AKgAAAAgAAQESAAMAAAABAAYAAAAAAAA="
)
GREEN = (0, 200, 0)
WHITE = (255, 255, 255)
BLACK = (0, 0, 0)


@pytest.fixture(autouse=True)
def _reader() -> None:
    pytest.importorskip("pi_heif", reason="the extra heic")


@pytest.fixture
def heic_path(tmp_path: Path) -> Path:
    path = tmp_path / "photo.heic"
    path.write_bytes(HEIC)
    return path


@pytest.mark.parametrize("read", [Path, Path.read_bytes])
def test_it_is_turned_upright(read: Callable[[Path], Any], heic_path: Path) -> None:
    with open_raster(read(heic_path)) as raster:
        assert (raster.width_px, raster.height_px) == (48, 64)
        pixels = raster.read().astype(int)
    for (y, x), colour in {
        (5, 5): GREEN,
        (60, 5): GREEN,
        (5, 40): WHITE,
        (60, 40): BLACK,
    }.items():
        assert np.abs(pixels[y, x] - colour).max() <= 3


def test_it_is_listed_among_the_images_of_a_folder(heic_path: Path) -> None:
    assert vehanchor.find_images(heic_path.parent) == [str(heic_path)]


def test_too_many_pixels_are_refused_before_decoding() -> None:
    limits = ImageLimits(max_pixels=3000)
    message = "the HEIC declares 48 x 64 px, the limit is 3000 pixels"
    with pytest.raises(ImageTooLargeError, match=message):
        open_raster(HEIC, Reading(limits=limits))


def test_too_much_memory_is_refused_before_decoding() -> None:
    limits = ImageLimits(max_decoded_bytes=10_000)
    with pytest.raises(ImageTooLargeError, match="decoding the HEIC"):
        open_raster(HEIC, Reading(limits=limits))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.99])
def test_a_file_that_is_cut_off_is_refused(share: float) -> None:
    with pytest.raises(ImageDecodeError, match="HEIC"):
        open_raster(HEIC[: int(share * len(HEIC))])


def test_a_picture_larger_than_declared_is_refused() -> None:
    start = HEIC.index(b"ispe") + 8
    small = (32).to_bytes(4) + (48).to_bytes(4)
    with pytest.raises(ImageDecodeError):
        open_raster(HEIC[:start] + small + HEIC[start + 8 :])


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pi_heif", "pillow_heif"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"vehanchor\[heic\].*or convert it to JPEG"):
        open_raster(HEIC)
