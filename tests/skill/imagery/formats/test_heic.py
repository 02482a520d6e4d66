"""HEIC is read through libheif: upright, and whole or not at all.

Too large an image is refused by its declared size, before decoding.

The picture ``HEIC`` has 64 x 48 px: the upper left quarter is white, the upper right quarter black,
the lower half green. Its container turns it to the right.
"""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vehanchor
from tests.skill.imagery.files import HEIC, header_of
from tests.skill.imagery.heic_files import (
    SIDE_PX,
    Item,
    grid,
    heic,
    identity,
    nested_overlays,
    overlay,
)
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
    with pytest.raises(MissingExtraError, match=r"\.\[heic\].*or convert it to JPEG"):
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


_NO_TEXT = b"\0\xff\xfe\0"
"""An empty name, and a type of a content that is not UTF-8."""

_POISONED_ITEMS = [
    Item(b"mime", b"<x/>", side_px=0, text=_NO_TEXT, refers=(b"cdsc", [1])),
    Item(b"uri ", b"<x/>", side_px=0, text=_NO_TEXT, refers=(b"cdsc", [1])),
    Item(b"E\xffif", b"abcd", side_px=0, refers=(b"cdsc", [1])),
]


@pytest.mark.promise("bombs")
@pytest.mark.parametrize("item", _POISONED_ITEMS)
def test_a_type_or_name_that_is_no_text_is_refused(item: Item) -> None:
    with pytest.raises(ImageDecodeError, match="no text"):
        header_of(heic([Item(), item]))


@pytest.mark.parametrize("item", _POISONED_ITEMS)
def test_metadata_of_a_type_that_is_no_text_do_not_end_the_process(item: Item) -> None:
    """Found by ``tests.fuzz``: pi-heif 1.4 crashed, if its metadata were not detached."""
    code = """
import sys
from vehanchor.imagery.formats.heic import open_heic
from vehanchor.options import ImageLimits
data = sys.stdin.buffer.read()
print(open_heic(data, "image", bands=None, limits=ImageLimits()).width_px)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=heic([Item(), item]),
        capture_output=True,
        check=False,
    )
    assert done.stdout == b"64\n", done.stderr


def test_pictures_that_are_put_together_are_read() -> None:
    tiles = [Item()] * 4
    with open_raster(heic([grid([2, 3, 4, 5], 2), *tiles])) as raster:
        assert (raster.width_px, raster.height_px) == (128, 128)


@pytest.mark.parametrize("primary", [None, 7])
def test_a_file_without_a_primary_image_is_refused(primary: int | None) -> None:
    with pytest.raises(ImageDecodeError, match="no primary image"):
        header_of(heic([Item()], primary))


@pytest.mark.promise("bombs")
def test_overlays_of_overlays_are_refused() -> None:
    """Seven levels of eight overlays are two million pictures: minutes of libheif."""
    bomb = nested_overlays(n_levels=7, n_pictures=8)
    assert len(bomb) < 10_000
    with pytest.raises(ImageTooLargeError, match="made of pictures of"):
        header_of(bomb)


@pytest.mark.promise("bombs")
def test_a_long_chain_of_pictures_is_refused() -> None:
    """Libheif's time grows with the square of the chain's length."""
    chain = [identity(number + 1) for number in range(1, 100)]
    with pytest.raises(ImageTooLargeError, match="more than 8 levels"):
        header_of(heic([*chain, Item()]))


@pytest.mark.promise("bombs")
@pytest.mark.parametrize("make", [overlay, lambda pictures: grid(pictures, 2)])
def test_a_canvas_larger_than_declared_is_refused(make: Callable[[list[int]], Item]) -> None:
    """Found by ``tests.fuzz.isolated``: 682 bytes took 2.6 GiB."""
    item = make([2, 3])
    size = struct.pack(">II", item.side_px, SIDE_PX)
    large = item._replace(data=item.data.replace(size, struct.pack(">II", 22_000, 22_000)))
    assert large != item
    with pytest.raises(ImageDecodeError, match="larger than it declares"):
        header_of(heic([large, Item(), Item()]))


@pytest.mark.promise("two-readers")
def test_a_canvas_in_several_pieces_is_refused() -> None:
    data = heic([overlay([2, 3]), Item(), Item()])
    n_items = data.index(b"iloc") + 10
    first_entry = data[n_items + 2 : n_items + 16]
    doubled = data[: n_items + 16] + first_entry + data[n_items + 30 :]
    with pytest.raises(ImageDecodeError, match="several pieces"):
        header_of(doubled)


def test_a_circle_of_pictures_is_refused() -> None:
    with pytest.raises(ImageTooLargeError, match="more than 8 levels"):
        header_of(heic([identity(2), identity(1)]))


@pytest.mark.promise("two-readers")
def test_two_lists_of_references_are_refused() -> None:
    data = HEIC.replace(b"hdlr", b"iref", 1)
    with pytest.raises(ImageDecodeError, match="two boxes b'iref'"):
        header_of(data)


@pytest.mark.promise("two-readers")
def test_two_headers_are_refused() -> None:
    with pytest.raises(ImageTooLargeError, match="two 'meta' boxes"):
        header_of(HEIC + b"\0\0\0\x08meta")


def test_a_primary_image_that_libheif_cannot_use_is_damaged() -> None:
    """Found by ``tests.fuzz``: pi-heif raised an IndexError."""
    configuration = HEIC.index(b"ipma") + 19
    with pytest.raises(ImageDecodeError, match="HEIC"):
        open_raster(HEIC[:configuration] + b"\x20" + HEIC[configuration + 1 :])


def test_a_last_box_that_is_cut_off_is_ignored() -> None:
    """Found by ``tests.fuzz``: its 64-bit length is missing, and a struct.error was raised."""
    with open_raster(HEIC + b"\0\0\0\x01free") as raster:
        assert raster.width_px == 48
