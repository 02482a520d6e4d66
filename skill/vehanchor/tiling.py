"""The tile grid: overlapping tiles that cover an image, each visited once."""

from __future__ import annotations

from vehanchor.imagery import Window

__all__ = ["TILE_OVERLAP", "TILE_SIZE_PX", "tile_grid"]

TILE_SIZE_PX = 1024  # paper, section III-B
TILE_OVERLAP = 0.25  # paper, section III-B: stride 768 px at 1024 px


def _starts(extent: int, tile: int, stride: int) -> list[int]:
    """Tile origins along one axis; the last tile is flush with the edge."""
    if extent <= tile:
        return [0]
    return [*range(0, extent - tile, stride), extent - tile]


def tile_grid(
    width_px: int, height_px: int, *, tile_px: int = TILE_SIZE_PX, stride_px: int | None = None
) -> list[Window]:
    """Tiles of an image in reading order.

    Args:
        width_px: image width.
        height_px: image height.
        tile_px: side of a tile; images smaller than that give one tile of their own size.
        stride_px: step between tiles, at most ``tile_px``; default three quarters of it (25 % overlap).

    Returns:
        Windows inside the image that cover every pixel, none twice.
    """
    step = round(tile_px * (1 - TILE_OVERLAP)) if stride_px is None else stride_px
    return [
        Window(x, y, min(tile_px, width_px), min(tile_px, height_px))
        for y in _starts(height_px, tile_px, step)
        for x in _starts(width_px, tile_px, step)
    ]
