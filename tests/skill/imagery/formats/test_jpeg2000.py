"""JPEG 2000: what a header makes a decoder do is known before it is decoded."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.file_check import check_file
from vehanchor.imagery.formats.codestream import read_siz, tile_cost
from vehanchor.imagery.formats.jpeg2000 import read_jpeg2000
from vehanchor.imagery.limits import block_bytes
from vehanchor.options import ImageLimits

_COD = b"\xff\x52"
_SOT = b"\xff\x90"
_SIDE_PX = 512


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A JP2 of 512 x 512 px with three bands and precincts for each resolution."""
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path_factory.mktemp("jp2") / "photograph.jp2"
    noise = np.random.default_rng(3).integers(0, 255, (3, _SIDE_PX, _SIDE_PX), np.uint8)
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(
            path,
            "w",
            driver="JP2OpenJPEG",
            width=_SIDE_PX,
            height=_SIDE_PX,
            count=3,
            dtype="uint8",
            BLOCKXSIZE=_SIDE_PX,
            BLOCKYSIZE=_SIDE_PX,
            PRECINCTS="{64,64},{64,64},{64,64}",
            RESOLUTIONS=6,
        ) as dataset,
    ):
        dataset.write(noise)
    return path.read_bytes()


def _reader(data: bytes) -> Any:
    def read_at(offset: int, size: int) -> bytes:
        return data[offset : offset + size]

    return read_at


def _check(data: bytes) -> None:
    check_file(_reader(data), len(data), "image", limits=ImageLimits(), on_disk=False)


def _with_precincts(data: bytes, exponents: int, *, resolutions: int = 6) -> bytes:
    """Replace the exponents of the precincts in the main coding style."""
    position = data.index(_COD) + 14
    return data[:position] + bytes([exponents] * resolutions) + data[position + resolutions :]


def _with_layers(data: bytes, layers: int) -> bytes:
    position = data.index(_COD) + 6
    return data[:position] + struct.pack(">H", layers) + data[position + 2 :]


def _with_tile_style(data: bytes, style: bytes) -> bytes:
    """Insert a coding style into the header of the first tile-part."""
    start = data.index(_SOT)
    length = int.from_bytes(data[start + 6 : start + 10]) + len(style)
    head = data[start : start + 6] + struct.pack(">I", length) + data[start + 10 : start + 12]
    return data[:start] + head + style + data[start + 12 :]


def test_a_real_file_is_accepted(photograph: bytes) -> None:
    _check(photograph)


def test_the_header_has_the_size_of_the_codestream(photograph: bytes) -> None:
    header = read_jpeg2000(_reader(photograph))
    assert (header.width_px, header.height_px, header.bands) == (_SIDE_PX, _SIDE_PX, 3)


def test_a_real_file_costs_less_than_its_pixels(photograph: bytes) -> None:
    header = read_jpeg2000(_reader(photograph))
    assert header.structure_bytes < 3 * 4 * header.tile_px


def _large(data: bytes, side_px: int) -> bytes:
    """Declare a larger image of one tile."""
    start = data.index(b"\xff\x4f\xff\x51") + 8
    sides = struct.pack(">2I", side_px, side_px)
    return data[:start] + sides + data[start + 8 : start + 16] + sides + data[start + 24 :]


@pytest.mark.parametrize("exponents", [0x00, 0x11, 0x22])
def test_tiny_precincts_are_refused_before_decoding(photograph: bytes, exponents: int) -> None:
    bomb = _with_precincts(_large(photograph, 2048), exponents)
    with pytest.raises(ImageTooLargeError, match=r"tiles|packets"):
        _check(bomb)


def test_tiny_precincts_of_a_tile_part_are_refused(photograph: bytes) -> None:
    start = photograph.index(_COD)
    length = 2 + int.from_bytes(photograph[start + 2 : start + 4])
    style = _with_precincts(photograph[start : start + length], 0x11)
    bomb = _with_tile_style(_large(photograph, 2048), style)
    with pytest.raises(ImageTooLargeError, match="tiles"):
        _check(bomb)


def test_tiny_precincts_of_one_component_are_refused(photograph: bytes) -> None:
    # COC: the component, its style with precincts, five levels, blocks of 64 px.
    body = bytes([1, 1, 5, 4, 4, 0, 0]) + bytes([0x11] * 6)
    style = b"\xff\x53" + struct.pack(">H", len(body) + 2) + body
    bomb = _with_tile_style(_large(photograph, 2048), style)
    with pytest.raises(ImageTooLargeError, match="tiles"):
        _check(bomb)


@pytest.mark.promise("bombs")
def test_very_many_tiles_are_refused(photograph: bytes) -> None:
    """Found by ``tests.fuzz.isolated``: a header of 24,600 tiles took 717 MiB.

    A file of 4,900 tiles of 16 px took more than 70 s, because GDAL reads each from the start.
    """
    tile_sides = photograph.index(b"\xff\x51") + 22
    small = struct.pack(">II", 7, 7)
    many = photograph[:tile_sides] + small + photograph[tile_sides + 8 :]
    with pytest.raises(ImageTooLargeError, match="5476 tiles, more than 1000"):
        _check(many)


@pytest.mark.promise("bombs")
def test_pixels_and_structures_of_a_tile_are_counted_together(photograph: bytes) -> None:
    bomb = _with_precincts(_large(photograph, 4000), 0x44)
    header = read_jpeg2000(_reader(bomb))
    pixel_bytes = block_bytes(header.tile_px, samples=header.bands, sample_bytes=4)
    assert max(header.structure_bytes, pixel_bytes) < ImageLimits().max_decoded_bytes
    with pytest.raises(ImageTooLargeError, match="decoding the JPEG 2000's tiles"):
        _check(bomb)


def test_many_layers_are_refused(photograph: bytes) -> None:
    with pytest.raises(ImageTooLargeError, match="packets"):
        _check(_with_layers(_with_precincts(photograph, 0x44), 65_535))


def test_many_small_tile_parts_are_refused(photograph: bytes) -> None:
    start = photograph.index(_SOT)
    part = _SOT + struct.pack(">HHIBB", 10, 0, 14, 0, 1) + b"\xff\x93"
    with pytest.raises(ImageTooLargeError, match="tile-parts"):
        _check(photograph[:start] + 70_000 * part)


def test_a_tile_part_without_end_is_refused(photograph: bytes) -> None:
    start = photograph.index(_SOT)
    damaged = photograph[: start + 6] + struct.pack(">I", 5) + photograph[start + 10 :]
    with pytest.raises(ImageDecodeError, match="tile-part"):
        _check(damaged)


@pytest.mark.parametrize("kind", [b"ihdr", b"colr"])
def test_a_box_without_length_within_another_is_refused(photograph: bytes, kind: bytes) -> None:
    start = photograph.index(kind) - 4
    endless = photograph[:start] + bytes(4) + photograph[start + 4 :]
    with pytest.raises(ImageDecodeError, match="no length"):
        _check(endless)


def test_an_invalid_style_is_refused(photograph: bytes) -> None:
    position = photograph.index(_COD) + 10
    damaged = photograph[:position] + b"\x0f" + photograph[position + 1 :]
    with pytest.raises(ImageDecodeError, match="coding style"):
        _check(damaged)


def test_a_style_that_is_cut_off_is_refused(photograph: bytes) -> None:
    """Found by ``tests.fuzz.isolated``: an IndexError was raised."""
    start = photograph.index(_COD)
    empty = photograph[: start + 2] + b"\0\2" + photograph[start + 4 :]
    with pytest.raises((ImageDecodeError, struct.error)):
        read_jpeg2000(_reader(empty))


def test_a_codestream_without_segments_is_refused(photograph: bytes) -> None:
    """Found by ``tests.fuzz.isolated``: a StopIteration was raised."""
    start = photograph.index(b"\xff\x51")
    without = photograph[:start] + photograph[photograph.index(_SOT) :]
    with pytest.raises(ImageDecodeError, match="invalid size"):
        read_jpeg2000(_reader(without))


def test_small_precincts_cost_more(photograph: bytes) -> None:
    start = photograph.index(b"\xff\x4f\xff\x51")
    costs = []
    for exponents in (0x66, 0x44, 0x22):
        read_at = _reader(_with_precincts(photograph, exponents))
        costs.append(tile_cost(read_at, start, read_siz(read_at, start)).structures)
    assert costs == sorted(costs)
    assert costs[0] < costs[-1] / 10


HOSTILE = Path(__file__).parents[4].parent / "shared" / "cases" / "hostile"


@pytest.mark.skipif(not HOSTILE.is_dir(), reason="needs ../shared")
def test_the_file_on_which_gdal_hangs_is_refused() -> None:
    with pytest.raises(ImageDecodeError, match="no length"):
        _check((HOSTILE / "hang.jp2").read_bytes())
