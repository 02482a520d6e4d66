"""Cost of a JPEG 2000 codestream: the structures that its coding styles make a decoder allocate.

A file of a few hundred bytes can divide a tile into millions of precincts and code blocks, or into
thousands of layers. All coding styles are read, those in the headers of tile-parts among them
(ISO/IEC 15444-1, annex A).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.ifd import ReadAt

_SOC = 0xFF4F
_SIZ = 0xFF51
_COD = 0xFF52
_COC = 0xFF53
_SOT = 0xFF90
_SOD = 0xFF93
_EOC = 0xFFD9

_MAX_SEGMENTS = 1_000
"""Maximum number of marker segments in one header; real files have a dozen."""

_MAX_TILE_PARTS = 65_536
"""Maximum number of tile-parts; a photograph of 2 gigapixels in tiles of 256 px has 30,000."""

_TILE_PART_HEAD_BYTES = 12
_WHOLE_TILE_EXPONENT = 15
"""Exponent of the precincts' sides where the coding style states none."""

_MAX_LEVELS = 32  # in the standard
_HAS_PRECINCTS = 1
"""Bit of the coding style that is set if it states the sides of the precincts."""

_MAX_PACKETS = 10_000_000
"""Maximum number of packets of a tile: layers times precincts. OpenJPEG visits each."""


class Siz(NamedTuple):
    """Sizes of the image and of its tiles.

    Attributes:
        width_px: width of the image.
        height_px: height of the image.
        tile_width_px: width of a whole tile, within the image.
        tile_height_px: height of a whole tile, within the image.
        n_tiles: number of tiles.
        subsampling: horizontal and vertical subsampling of each component.
    """

    width_px: int
    height_px: int
    tile_width_px: int
    tile_height_px: int
    n_tiles: int
    subsampling: tuple[tuple[int, int], ...]


class _Style(NamedTuple):
    """Coding style of components.

    Attributes:
        levels: number of wavelet decompositions.
        block_width_exponent: log2 of a code block's width.
        block_height_exponent: log2 of its height.
        precinct_exponents: log2 of width and height of the precincts, from the lowest resolution.
    """

    levels: int
    block_width_exponent: int
    block_height_exponent: int
    precinct_exponents: tuple[tuple[int, int], ...]


class _Segment(NamedTuple):
    """Marker segment.

    Attributes:
        marker: its marker.
        body: its content, without marker and length.
        end: offset of the byte after it.
    """

    marker: int
    body: bytes
    end: int


class TileCost(NamedTuple):
    """Cost of the most expensive tile.

    Attributes:
        structures: precincts of all subbands, and code blocks.
        packets: layers times precincts.
    """

    structures: int
    packets: int


def read_siz(read_at: ReadAt, start: int) -> Siz:
    """Read the sizes at the start of a codestream.

    Args:
        read_at: reads bytes of the file.
        start: offset of the codestream.

    Raises:
        ImageDecodeError: there is no codestream, or a size is invalid.
        struct.error: the file ends within its header.
    """
    segments = _segments(read_at, start + 2)
    first = next(segments, None)
    is_codestream = read_at(start, 2) == _SOC.to_bytes(2)
    if not is_codestream or first is None or first.marker != _SIZ:
        raise ImageDecodeError("the JPEG 2000 declares an invalid size: damaged")
    (
        right,
        bottom,
        left,
        top,
        tile_width,
        tile_height,
        tile_left,
        tile_top,
        n_components,
    ) = struct.unpack_from(">8IH", first.body, 2)
    steps = struct.unpack_from(f">{3 * n_components}B", first.body, 36)
    subsampling = tuple(zip(steps[1::3], steps[2::3], strict=True))
    width = right - left
    height = bottom - top
    has_pixels = min(width, height, tile_width, tile_height) >= 1
    if not has_pixels or not subsampling or not all(map(all, subsampling)):
        raise ImageDecodeError("the JPEG 2000 declares an invalid size: damaged")
    tiles_across = _divided_up(max(0, right - tile_left), tile_width)
    tiles_down = _divided_up(max(0, bottom - tile_top), tile_height)
    return Siz(
        width,
        height,
        tile_width_px=min(tile_width, width),
        tile_height_px=min(tile_height, height),
        n_tiles=tiles_across * tiles_down,
        subsampling=subsampling,
    )


def tile_cost(read_at: ReadAt, start: int, siz: Siz) -> TileCost:
    """Compute the cost of a tile under the most expensive of all coding styles.

    Args:
        read_at: reads bytes of the file.
        start: offset of the codestream.
        siz: its sizes.

    Raises:
        ImageDecodeError: a coding style or a tile-part is invalid.
        ImageTooLargeError: there are too many segments, tile-parts or packets.
        struct.error: the file ends within a segment.
    """
    n_components = len(siz.subsampling)
    layers = 1
    style_costs: dict[_Style, list[int]] = {}
    default_style = None
    for segment in _style_segments(read_at, start):
        if segment.marker == _COD:
            flags, _, n_layers, _ = struct.unpack_from(">BBHB", segment.body)
            layers = max(layers, n_layers)
            style = _read_style(segment.body[5:], flags)
            default_style = default_style or style
        else:
            # The number of the component takes two bytes if there are more than 256.
            index_bytes = 1 if n_components < 257 else 2
            (flags,) = struct.unpack_from(">B", segment.body, index_bytes)
            style = _read_style(segment.body[index_bytes + 1 :], flags)
        style_costs[style] = []
    if default_style is None:
        raise ImageDecodeError("the JPEG 2000 declares no coding style: damaged")

    # Each component takes the most expensive style, whichever tile it is declared for.
    structures = 0
    precincts = 0
    component_costs: dict[tuple[int, int], TileCost] = {}
    for steps in siz.subsampling:
        if steps not in component_costs:
            costs = [_component_cost(style, siz, steps) for style in style_costs]
            component_costs[steps] = TileCost(
                max(cost.structures for cost in costs), max(cost.packets for cost in costs)
            )
        structures += component_costs[steps].structures
        precincts += component_costs[steps].packets
    packets = layers * precincts
    if packets > _MAX_PACKETS:
        raise ImageTooLargeError(
            f"the JPEG 2000 has {packets} packets in a tile, more than {_MAX_PACKETS}: save it "
            "again with fewer layers and larger precincts"
        )
    return TileCost(structures, packets)


def _style_segments(read_at: ReadAt, start: int) -> Iterator[_Segment]:
    """Yield the coding styles (COD, COC) of the main header and of all tile-parts.

    POC only changes the order of packets, so that it costs nothing more.
    """
    position = start + 2
    for segment in _segments(read_at, position):
        if segment.marker in (_COD, _COC):
            yield segment
        position = segment.end
    for _ in range(_MAX_TILE_PARTS):
        head = read_at(position, _TILE_PART_HEAD_BYTES)
        if len(head) < _TILE_PART_HEAD_BYTES or int.from_bytes(head[:2]) != _SOT:
            return
        length = int.from_bytes(head[6:10])
        for segment in _segments(read_at, position + _TILE_PART_HEAD_BYTES):
            if segment.marker in (_COD, _COC):
                yield segment
        if length == 0:  # the last tile-part reaches to the end of the codestream
            return
        if length < _TILE_PART_HEAD_BYTES:
            raise ImageDecodeError("the JPEG 2000 has a tile-part of impossible length: damaged")
        position += length
    raise ImageTooLargeError(
        f"the JPEG 2000 has more than {_MAX_TILE_PARTS} tile-parts: save it again with larger tiles"
    )


def _segments(read_at: ReadAt, position: int) -> Iterator[_Segment]:
    """Yield the marker segments of a header, up to a tile-part, its data or the end.

    Raises:
        ImageDecodeError: a marker or its length is impossible.
        ImageTooLargeError: there are too many segments.
        struct.error: the file ends within a segment.
    """
    for _ in range(_MAX_SEGMENTS):
        marker, length = struct.unpack(">HH", read_at(position, 4))
        if marker in (_SOT, _SOD, _EOC):
            return
        if marker < 0xFF00 or length < 2:
            raise ImageDecodeError("the JPEG 2000 has a damaged header")
        body = b""
        if marker in (_SIZ, _COD, _COC):
            body = read_at(position + 4, length - 2)
            if len(body) < length - 2:
                raise struct.error
        end = position + 2 + length
        yield _Segment(marker, body, end)
        position = end
    raise ImageTooLargeError(
        f"the JPEG 2000 has more than {_MAX_SEGMENTS} parts in a header: save it again"
    )


def _read_style(parameters: bytes, flags: int) -> _Style:
    """Read the parameters of a coding style (SPcod or SPcoc, tables A.20 and A.21).

    Args:
        parameters: the parameters.
        flags: the style itself (Scod or Scoc).

    Raises:
        ImageDecodeError: a number is outside the standard.
        struct.error: the segment is too short.
    """
    levels, width_exponent, height_exponent, _, _ = struct.unpack_from(">5B", parameters)
    block_width_exponent = width_exponent + 2
    block_height_exponent = height_exponent + 2
    has_valid_blocks = (
        max(block_width_exponent, block_height_exponent) <= 10
        and block_width_exponent + block_height_exponent <= 12
    )
    if levels > _MAX_LEVELS or not has_valid_blocks:
        raise ImageDecodeError("the JPEG 2000 declares an invalid coding style: damaged")
    exponents = [(_WHOLE_TILE_EXPONENT, _WHOLE_TILE_EXPONENT)] * (levels + 1)
    if flags & _HAS_PRECINCTS:
        sizes = struct.unpack_from(f">{levels + 1}B", parameters, 5)
        exponents = [(size & 15, size >> 4) for size in sizes]
    return _Style(levels, block_width_exponent, block_height_exponent, tuple(exponents))


def _component_cost(style: _Style, siz: Siz, steps: tuple[int, int]) -> TileCost:
    """Count the structures and the precincts of a component in a whole tile (annex B.6, B.7)."""
    step_across, step_down = steps
    structures = 0
    n_precincts = 0
    for resolution, (width_exponent, height_exponent) in enumerate(style.precinct_exponents):
        reduction = style.levels - resolution
        width = _divided_up(siz.tile_width_px, step_across << reduction)
        height = _divided_up(siz.tile_height_px, step_down << reduction)
        # One more where the tile's first column or row is not that of a precinct.
        across = _divided_up(width, 1 << width_exponent) + 1
        down = _divided_up(height, 1 << height_exponent) + 1
        n_subbands = 1 if resolution == 0 else 3
        # A subband has half of its resolution's columns and rows, except for the lowest.
        halving = 0 if resolution == 0 else 1
        block_width_exponent = min(style.block_width_exponent, max(0, width_exponent - halving))
        block_height_exponent = min(style.block_height_exponent, max(0, height_exponent - halving))
        blocks_across = _divided_up(width, 1 << block_width_exponent + halving) + across
        blocks_down = _divided_up(height, 1 << block_height_exponent + halving) + down
        n_precincts += across * down
        structures += n_subbands * (across * down + blocks_across * blocks_down)
    return TileCost(structures, n_precincts)


def _divided_up(number: int, divisor: int) -> int:
    """Divide and round up."""
    return -(-number // divisor)
