"""HEIC is read through libheif: upright, and whole or not at all.

Too large an image is refused by its declared size, before decoding.

The picture ``HEIC`` has 64 x 48 px: the upper left quarter is white, the upper right quarter black,
the lower half green. Its container turns it to the right.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehanchor
from tests.skill.imagery.files import HEIC, header_of
from vehanchor.errors import ImageDecodeError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

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
    message = "the HEIC has 64 x 64 px, the limit is 3000 pixels"
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


def test_its_header_is_read_without_libheif(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pi_heif", "pillow_heif"):
        monkeypatch.setitem(sys.modules, name, None)
    header = header_of(HEIC)
    assert (header.format, header.width_px, header.height_px) == ("HEIC", 64, 64)
    assert header.complete


@pytest.mark.parametrize("share", [0.75, 0.9, 0.99])
def test_its_header_shows_that_the_file_is_cut_off(share: float) -> None:
    assert not header_of(HEIC[: int(share * len(HEIC))]).complete


def test_a_header_without_a_size_is_damaged() -> None:
    with pytest.raises(ImageDecodeError, match="HEIC declares no size"):
        header_of(HEIC.replace(b"ispe", b"free"))


def test_more_items_than_libheif_reads_are_refused() -> None:
    n_items = HEIC.index(b"iloc") + 10
    many = HEIC[:n_items] + (1001).to_bytes(2) + HEIC[n_items + 2 :]
    with pytest.raises(ImageTooLargeError, match="more than 1000 parts"):
        header_of(many)


def test_metadata_of_a_type_that_is_no_text_do_not_end_the_process() -> None:
    """Found by ``tests.fuzz``: pi-heif 1.4 crashed."""
    data = HEIC.replace(b"Exif\0\0\0\0\x0epitm", b"E\xffif\0\0\0\0\x0epitm")
    assert data != HEIC
    code = "import sys; from vehanchor.imagery.sources.opening import open_raster\n"
    code += "print(open_raster(sys.stdin.buffer).width_px)"
    done = subprocess.run(
        [sys.executable, "-c", code], input=data, capture_output=True, check=False
    )
    assert done.stdout == b"48\n"


def test_a_primary_image_that_libheif_cannot_use_is_damaged() -> None:
    """Found by ``tests.fuzz``: pi-heif raised an IndexError."""
    configuration = HEIC.index(b"ipma") + 19
    with pytest.raises(ImageDecodeError, match="HEIC"):
        open_raster(HEIC[:configuration] + b"\x20" + HEIC[configuration + 1 :])


def test_a_last_box_that_is_cut_off_is_ignored() -> None:
    """Found by ``tests.fuzz``: its 64-bit length is missing, and a struct.error was raised."""
    with open_raster(HEIC + b"\0\0\0\x01free") as raster:
        assert raster.width_px == 48
