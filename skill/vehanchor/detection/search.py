"""The search of an image: overlapping tiles at one or more resolutions, and what they show merged into one sighting."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.detection.nms import oriented_nms
from vehanchor.detection.sighting import Objects, Sighting
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.tiles import TILE_OVERLAP, TILE_SIZE_PX, read_reduced_window, tile_grid
from vehanchor.options import Search

if TYPE_CHECKING:
    from collections.abc import Callable

    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector, TileSighting
    from vehanchor.imagery.raster import Raster, Window

__all__ = ["SearchLevel", "search", "search_levels"]

SEARCH_FACTORS = (1, 2, 4, 8)  # the image is searched at 1/1, 1/2, 1/4 and 1/8: a third more pixels in all
MIN_LEVEL_SIDE_PX = 96  # a reduced image with a shorter side is not searched: it would hold a car or two
LEVEL_OVERLAP = 1.25  # factor by which the length ranges of two levels overlap: a car at their border is seen by both
_MIN_TILE_PX = 32


class SearchLevel(NamedTuple):
    """One resolution at which an image is searched, and the lengths that count there.

    Attributes:
        factor: the image is reduced by it.
        width_px: columns of the reduced image.
        height_px: its rows.
        shortest_px: shortest vehicle that counts here, in pixels of the reduced image.
        longest_px: longest one.
    """

    factor: int
    width_px: int
    height_px: int
    shortest_px: float
    longest_px: float

    def counts(self, lengths_px: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which vehicles count here, by their lengths in pixels of the reduced image."""
        return (lengths_px >= self.shortest_px) & (lengths_px <= self.longest_px)


def search_levels(
    width_px: int, height_px: int, length_range_px: tuple[float, float], *, search_scales: bool
) -> list[SearchLevel]:
    """The resolutions at which an image is searched, finest first.

    A vehicle is measured at the finest level at which it is not longer than what the model was trained on: there it has
    the most pixels. So each coarser level counts the lengths from half of that limit up, less an overlap: a fleet at
    the border of two levels is cut off by neither, and boxes of one vehicle found twice are merged by the non-maximum
    suppression. The finest level has no lower and the coarsest no upper limit.

    Args:
        width_px: of the image.
        height_px: of the image.
        length_range_px: shortest and longest vehicle that the model was trained on.
        search_scales: False gives full resolution alone.

    Returns:
        Levels whose shorter side has at least 96 px; always full resolution.
    """
    longest = length_range_px[1]
    shortest = longest / 2 / LEVEL_OVERLAP
    factors = [
        factor
        for factor in SEARCH_FACTORS
        if factor == 1 or (search_scales and min(width_px, height_px) // factor >= MIN_LEVEL_SIDE_PX)
    ]
    return [
        SearchLevel(
            factor,
            width_px // factor,
            height_px // factor,
            0.0 if factor == 1 else shortest,
            np.inf if factor == factors[-1] else longest,
        )
        for factor in factors
    ]


def search(
    raster: Raster,
    detector: Detector,
    options: Search | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> Sighting:
    """Search an image tile by tile, at one or more resolutions, and merge the results (paper, section III-B).

    Args:
        raster: the image; only one tile of it is held at a time.
        detector: the model.
        options: how to search; None for the defaults.
        progress: called with (tiles done, tiles in all); an exception it raises ends the search.
        run_options: see ``Detector.detect_tile``.

    Returns:
        Vehicles and other objects in image pixels, after oriented non-maximum suppression.

    Raises:
        InvalidParameterError: a tile larger than the model's fixed input, a stride beyond the tile.
    """
    chosen = options or Search()
    card = detector.card
    tile_px, stride_px = _tile_and_stride(detector.fixed_size, chosen)
    min_score = card.min_score if chosen.min_score is None else chosen.min_score
    search_scales = card.search_scales if chosen.search_scales is None else chosen.search_scales
    levels = search_levels(raster.width_px, raster.height_px, card.length_range_px, search_scales=search_scales)
    visits = [
        (level, tile)
        for level in levels
        for tile in tile_grid(level.width_px, level.height_px, tile_px=tile_px, stride_px=stride_px)
    ]
    vehicle_parts, other_parts, scale_parts, n_capped = [], [], [np.zeros(0)], 0
    for done, (level, tile) in enumerate(visits):
        if progress:
            progress(done, len(visits))
        pixels = read_reduced_window(raster, tile, level.factor)
        seen = _seen(detector, pixels, level, min_score, run_options)
        n_capped += seen.ran_out
        vehicle_parts.append(_in_image(seen.vehicles, tile, level, tile_px - stride_px))
        scale_parts.append(np.full(len(vehicle_parts[-1]), 1 / level.factor))
        other_parts.append(_in_image(seen.others, tile, level, tile_px - stride_px))
    if progress:
        progress(len(visits), len(visits))
    vehicles = Objects.joined(vehicle_parts)
    kept = oriented_nms(vehicles.boxes, vehicles.scores, iou_threshold=chosen.nms_iou)
    vehicles = vehicles.take(kept)
    return Sighting(
        vehicles.boxes,
        vehicles.scores,
        len(visits),
        n_capped,
        np.concatenate(scale_parts)[kept] if search_scales else None,
        detector.fleet.look(raster, vehicles.boxes) if detector.fleet else None,
        vehicles.classes,
        _merged_by_class(Objects.joined(other_parts), chosen.nms_iou),
    )


def _seen(
    detector: Detector,
    pixels: NDArray[np.uint8],
    level: SearchLevel,
    min_score: float,
    run_options: onnxruntime.RunOptions | None,
) -> TileSighting:
    """One tile's objects that count: vehicles of the level's lengths, after the second look where there is one."""
    look = detector.second_look
    # What the detector alone doubts may turn out to be a car.
    seen = detector.detect_tile(pixels, min(min_score, look.card.least_score) if look else min_score, run_options)
    vehicles = seen.vehicles.take(level.counts(seen.vehicles.boxes[:, 2]))
    if look:
        vehicles = look.judged(pixels, vehicles, run_options)
        vehicles = vehicles.take(vehicles.scores >= min_score)
    # The range of lengths is that of vehicles: it says nothing of other objects.
    return seen._replace(vehicles=vehicles, others=seen.others.take(seen.others.scores >= min_score))


def _tile_and_stride(fixed_size: tuple[int, int] | None, options: Search) -> tuple[int, int]:
    """Side of the tiles and step between them, pixels."""
    tile_px = options.tile_px
    if tile_px is None:
        tile_px = min(fixed_size) if fixed_size else TILE_SIZE_PX
    if fixed_size and tile_px > min(fixed_size):
        raise InvalidParameterError(f"tile_px is {tile_px}, but the model's input is fixed at {fixed_size}")
    stride_px = round(tile_px * (1 - TILE_OVERLAP)) if options.stride_px is None else options.stride_px
    if tile_px < _MIN_TILE_PX or not 1 <= stride_px <= tile_px:
        raise InvalidParameterError(
            f"tile_px {tile_px}, stride_px {stride_px}: use a tile >= {_MIN_TILE_PX} and a stride within it"
        )
    return tile_px, stride_px


def _in_image(found: Objects, tile: Window, level: SearchLevel, overlap_px: int) -> Objects:
    """A tile's objects in pixels of the image, without those of which another tile sees more."""
    whole = found.take(~_cut_by_tile(found.boxes, tile, level, overlap_px))
    boxes = whole.boxes.copy()
    boxes[:, :2] += tile.x_px, tile.y_px
    boxes[:, :4] *= level.factor
    return Objects(boxes, whole.scores, whole.classes)


def _cut_by_tile(boxes: NDArray[np.float64], tile: Window, level: SearchLevel, overlap_px: int) -> NDArray[np.bool_]:
    """Boxes cut by a tile's inner edge, which the next tile sees whole: their length is not the vehicle's."""
    corners = box_corners(boxes)
    low, high = corners.min(axis=1), corners.max(axis=1)
    over = np.zeros(len(boxes), dtype=bool)
    if tile.x_px > 0:
        over |= low[:, 0] < 1
    if tile.y_px > 0:
        over |= low[:, 1] < 1
    if tile.x_px + tile.width_px < level.width_px:
        over |= high[:, 0] > tile.width_px - 1
    if tile.y_px + tile.height_px < level.height_px:
        over |= high[:, 1] > tile.height_px - 1
    return over & (boxes[:, 2] < overlap_px)


def _merged_by_class(found: Objects, nms_iou: float) -> Objects:
    """Objects after non-maximum suppression within each class, best score first; of equal ones the lower class."""
    parts = []
    for index in np.unique(found.classes):
        members = found.take(found.classes == index)
        parts.append(members.take(oriented_nms(members.boxes, members.scores, iou_threshold=nms_iou)))
    merged = Objects.joined(parts)
    return merged.take(np.argsort(-merged.scores, kind="stable"))
