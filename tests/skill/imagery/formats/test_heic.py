"""HEIC is read through libheif: upright, whole or not at all, refused by its declared size before decoding.

No encoder of HEVC is free of the GPL, so that the picture is here as it was encoded once, by
pillow-heif: 64 x 48 px, the upper left quarter white, the lower half green, the upper right quarter
black, and turned to the right by its container.
"""

from __future__ import annotations

import base64
import sys
from pathlib import Path

import numpy as np
import pytest

import vehanchor
from vehanchor.errors import ImageDecodeError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

HEIC = base64.b64decode(
    "AAAAHGZ0eXBoZWl4AAAAAG1pZjFoZWl4bWlhZgAAAcltZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAAADRpbG9jAA"
    "AAAERAAAIAAQAAAAAB7QABAAAAAAAAAMQAAgAAAAACsQABAAAAAAAAACQAAAA4aWluZgAAAAAAAgAAABVpbmZlAgAAAAABAABodmMxAAAAABVp"
    "bmZlAgAAAQACAABFeGlmAAAAAA5waXRtAAAAAAABAAABCGlwcnAAAADnaXBjbwAAAHdodmNDAQQIAAAAnjgAAAAAHvAA/P/4+AAADwNgAAEAF0"
    "ABDAH//wQIAAADAJ44AAADAAAeugJAYQABACpCAQEECAAAAwCeOAAAAwAAHpAEECCy3VyU1zcBDQYEAAADAGQAAAMABCBiAAEACEQBwXMYMAiQ"
    "AAAAE2NvbHJuY2x4AAEADQAGgAAAABRpc3BlAAAAAAAAAEAAAABAAAAAKGNsYXAAAABAAAAAAQAAADAAAAABAAAAAAAAAAL////wAAAAAgAAAB"
    "BwaXhpAAAAAAMICAgAAAAJaXJvdAMAAAAZaXBtYQAAAAAAAAABAAEGgQIDBYSGAAAAGmlyZWYAAAAAAAAADmNkc2MAAgABAAEAAADwbWRhdAAA"
    "AMAoAa8GOFtj5Wb/Su5JaK3xpPa5v+cNv//6XD//7SlxVQ3/u7Ur4I++nH7Y/03+agIZ/3dqV8EffTj9sf6b/NX/zRnlDEjFJYob8WXUaP3S/3"
    "n772ztftfM0IQ1xhBKfsX+i6xQ/0FrxtrkEE2Vcp1C8EU0Kldd5xz/hCkEekIv/7X/vr/74sH5Y3aVPWZPL26irBJPr88ZBD6e227FRktwW7Km"
    "A5R8Atn2YtenfFfI3a2+Pvg1ehkS+Il9d83kFrsAAAAGRXhpZgAATU0AKgAAAAgAAQESAAMAAAABAAYAAAAAAAA="
)
GREEN = (0, 200, 0)
WHITE = (255, 255, 255)
BLACK = (0, 0, 0)


@pytest.fixture(autouse=True)
def _reader() -> None:
    pytest.importorskip("pi_heif", reason="the extra heic")


def test_it_is_turned_upright(tmp_path: Path) -> None:
    (tmp_path / "photo.heic").write_bytes(HEIC)
    for source in (HEIC, tmp_path / "photo.heic"):
        with open_raster(source) as raster:
            pixels = raster.read().astype(int)
            assert (raster.width_px, raster.height_px) == (48, 64)
        for (y, x), colour in {
            (5, 5): GREEN,
            (60, 5): GREEN,
            (5, 40): WHITE,
            (60, 40): BLACK,
        }.items():
            assert np.abs(pixels[y, x] - colour).max() <= 3
    assert vehanchor.find_images(tmp_path) == [str(tmp_path / "photo.heic")]


def test_its_size_is_held_against_the_limits_before_it_is_decoded() -> None:
    with pytest.raises(
        ImageTooLargeError, match="the HEIC declares 48 x 64 px, the limit is 3000 pixels"
    ):
        open_raster(HEIC, Reading(limits=ImageLimits(max_pixels=3000)))
    with pytest.raises(ImageTooLargeError, match="decoding the HEIC"):
        open_raster(HEIC, Reading(limits=ImageLimits(max_decoded_bytes=10_000)))


@pytest.mark.parametrize("kept", [0.3, 0.6, 0.9, 0.99])
def test_one_that_was_cut_off_is_refused(kept: float) -> None:
    with pytest.raises(ImageDecodeError, match="HEIC"):
        open_raster(HEIC[: int(kept * len(HEIC))])


def test_one_that_hides_a_larger_picture_is_refused() -> None:
    at = HEIC.index(b"ispe") + 8
    with pytest.raises(ImageDecodeError):
        open_raster(HEIC[:at] + (32).to_bytes(4) + (48).to_bytes(4) + HEIC[at + 8 :])


def test_without_the_extra_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pi_heif", "pillow_heif"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"vehanchor\[heic\].*or convert it to JPEG"):
        open_raster(HEIC)
