"""Search of an image: overlapping tiles at one or more resolutions, merged into one ``Detections``.

Tiles are visited where cars are likely first. Resolutions that the scene-scale prior excludes come
last, and only if the others show few vehicles. The caller ends the search of a photograph or a
larger image when more tiles cannot change its scale. In crowded tiles the verifier scores a sample
of the candidates. At the end the chip network looks at the best vehicles, scores them again and
replaces their boxes by those of their bodies; if they are few, it looks at weaker candidates, too.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.boxes import box_corners, oriented_nms
from vehanchor.detection.chips import with_appearance
from vehanchor.detection.detections import Detections, Objects
from vehanchor.detection.proportions import stretch, stretch_of_few
from vehanchor.detection.scheduler import (
    LARGE_PIXELS,
    WINDOWED_PIXELS,
    TileScheduler,
    first_pause,
    level_chances,
    level_shares,
    most_tiles,
    next_pause,
    position_sample,
    search_levels,
    tile_prior_map,
    tile_prior_of,
)
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.tiles import TILE_OVERLAP, TILE_SIZE_PX, read_reduced_window, tile_grid
from vehanchor.options import Search

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector, PreparedTile, TileDetections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.detection.scheduler import SearchLevel
    from vehanchor.imagery.raster import Raster, Window
    from vehanchor.scale.defaults import Stopped

_MIN_TILE_PX = 32
_LEAST_CHANCE = 0.01  # of cars at a resolution; most of it is the floor of the scene-scale prior
# of cars at a resolution, by the vehicles found at others; one clear car leaves 2 to 3 %
_EXCLUDED_CHANCE = 0.03
# up to this number, the chip network looks at weaker candidates and at mirrored chips
_FEW_VEHICLES = 12
_MOST_CANDIDATES = 24  # then, best scores first
_MOST_LOOKED_AT = 64  # vehicles; 100 give the same answers to 1,957 photographs
# candidates of a tile, chosen by position; more cost as much as another tile and add less
_MOST_VERIFIED = 128
# from so many vehicles on, candidates of a tile: they hardly move the scale
_MANY_VEHICLES = 500
_LEAST_VERIFIED = 32
_ENOUGH_VEHICLES = 5  # at the other resolutions, to skip an unlikely one; the prior may be wrong
# tiles that are scheduled together; each is read while the model runs on the one before
_TILES_AT_ONCE = 4


class ImageSearch:
    """Search of an image (paper, section III-B), which visits tiles while it is iterated over.

    An iteration yields the expected share of the vehicles in the tiles that are not visited, at
    growing intervals; its caller may then ask for the ``result`` so far, ``leave_out`` resolutions,
    or ``stop``.

    Args:
        raster: the image; at most two of its tiles are in memory.
        detector: the model; the search reports its tiles to the progress of the detector's runtime.
        options: how to search; None for the defaults.
        prior: scene-scale prior, which orders the resolutions and weighs the boxes' sizes; None
            without one.

    Raises:
        InvalidParameterError: a tile larger than the model's fixed input, a stride beyond the tile.
    """

    def __init__(
        self,
        raster: Raster,
        detector: Detector,
        options: Search | None = None,
        prior: SceneScalePrior | None = None,
    ) -> None:
        options = options or Search()
        card = detector.card
        self._raster = raster
        self._detector = detector
        self._prior = prior
        self._nms_iou = options.nms_iou
        self._verifier = detector.verifier if options.verify else None
        self._chips = detector.chips if options.verify else None
        tile_px, stride_px = _tile_and_stride(detector.fixed_size, options)
        self._overlap_px = tile_px - stride_px
        self._min_score = card.min_score if options.min_score is None else options.min_score
        self._least_score = self._min_score  # of the candidates that are kept
        if self._chips:
            self._least_score = min(self._min_score, self._chips.card.least_score)
        self._search_scales = (
            card.search_scales if options.search_scales is None else options.search_scales
        )
        self._card_range_px = card.length_range_px
        self.levels = search_levels(
            raster.width_px,
            raster.height_px,
            card.length_range_px,
            search_scales=self._search_scales,
        )
        self.visits = [
            (level, tile)
            for level in self.levels
            for tile in tile_grid(
                level.width_px, level.height_px, tile_px=tile_px, stride_px=stride_px
            )
        ]
        n_pixels = raster.width_px * raster.height_px
        self._every_level = options.effort == "full"
        self._max_seconds = options.max_seconds or math.inf
        self._most = most_tiles(options, n_pixels, len(self.visits))
        self._pause = first_pause(options, n_pixels)
        self._found: dict[int, TileDetections] = {}
        self._n_skipped = 0
        self._because: Stopped | None = None
        self._left_out: frozenset[int] = frozenset()

    def __iter__(self) -> Iterator[float]:
        """Visit tiles until the limits or the caller end the search."""
        tell = self._detector.runtime.tell
        total = len(self.visits)
        if self._every_level and self._most == total and self._max_seconds == math.inf:
            order = self._reading_order()
            for k, tile in self._read(order):
                tell(self.n_visited, len(order))
                self._visit(k, tile)
        else:
            yield from self._likely_first(tell)
        unfinished: Stopped = "max_tiles" if self.n_visited == self._most else "converged"
        self._because = self._because or ("all_searched" if self.n_visited == total else unfinished)
        tell(total, total)

    def searched(self) -> Detections:
        """Visit tiles to the limits of the options, and merge what they show."""
        for _ in self:
            pass
        return self.result()

    def stop(self) -> None:
        """End the search: more tiles cannot change the scale."""
        self._because = "converged"

    def _likely_first(self, tell: Callable[[int, int], None]) -> Iterator[float]:
        """Visit likely resolutions and tiles first, until the limits or the caller end the search."""
        started = time.monotonic()
        due = self._pause
        most = self._most
        for factors in self._levels_by_chance():
            order = self._order(factors)
            if self.n_visited and self.n_vehicles >= _ENOUGH_VEHICLES:
                return self.stop()
            pause = bool(self.n_visited) and due is not None
            while True:
                if pause:
                    yield order.unseen_share
                    if self._because:
                        return None
                    order.leave_out(self._left_out)
                tiles = order.next_tiles(min(_TILES_AT_ONCE, most - self.n_visited))
                if not tiles:
                    break
                for k, tile in self._read(tiles):
                    if self.n_visited and time.monotonic() - started > self._max_seconds:
                        self._because = "max_seconds"
                        return None
                    tell(self.n_visited, len(self.visits))
                    order.report(k, self._visit(k, tile))
                pause = due is not None and due <= self.n_visited < most
                due = next_pause(self.n_visited) if pause else due
        return None

    @property
    def n_visited(self) -> int:
        """Number of visited tiles."""
        return len(self._found)

    @property
    def n_vehicles(self) -> int:
        """Number of vehicles found so far, before duplicates are merged."""
        return sum(self._count(seen.vehicles) for seen in self._found.values())

    def _count(self, vehicles: Objects) -> int:
        return int(np.count_nonzero(vehicles.scores >= self._min_score))

    def _order(self, factors: Collection[int]) -> TileScheduler:
        """Schedule the tiles of some resolutions by the tile prior and the scene-scale prior."""
        tiles = [(level.factor, tile) for level, tile in self.visits]
        priors = np.array([tile_prior_of(self._cells, tile, factor) for factor, tile in tiles])
        density = None if self._prior is None else self._prior.density
        ranges = {
            factor: lengths
            for factor, lengths in self._length_ranges_px().items()
            if factor in factors
        }
        return TileScheduler(tiles, priors, level_shares(ranges, density))

    @cached_property
    def _cells(self) -> NDArray[np.float64]:
        return tile_prior_map(self._raster)

    def _levels_by_chance(self) -> list[frozenset[int]]:
        """Group the resolutions: first those that may show cars, last those at which the prior excludes them."""
        ranges = self._length_ranges_px()
        everything = frozenset(ranges)
        if self._prior is None or self._every_level:
            return [everything]
        chances = level_chances(ranges, self._prior.density)
        likely = frozenset(factor for factor, chance in chances.items() if chance >= _LEAST_CHANCE)
        return [group for group in (likely, everything - likely) if group]

    def leave_out(self, density: NDArray[np.float64]) -> None:
        """Leave out the resolutions that the scale found so far makes superfluous; none without a prior.

        Cars there have a length that the detector does not know, or, in a photograph, that a finer
        resolution accepts as well. In larger images the tiles of a coarser one show more cars, and
        few are visited.

        Args:
            density: ``[g]`` of the scale on ``vehanchor.scale.density.GRID``.
        """
        if self._prior is None:
            return
        ranges = self._length_ranges_px()
        if self._raster.width_px * self._raster.height_px < LARGE_PIXELS:
            for level in self.levels:
                shortest, longest = ranges[level.factor]
                ranges[level.factor] = max(shortest, level.shortest_own_px), longest
        chances = level_chances(ranges, density)
        self._left_out = frozenset(
            factor for factor, chance in chances.items() if chance < _EXCLUDED_CHANCE
        )

    def _length_ranges_px(self) -> dict[int, tuple[float, float]]:
        shortest = self._card_range_px[0]
        return {
            level.factor: (max(shortest, level.shortest_px), level.longest_px)
            for level in self.levels
        }

    def _reading_order(self) -> list[int]:
        """List all tiles; in a large image a coarse tile follows the fine ones under it, which are still decoded."""
        if self._raster.width_px * self._raster.height_px < WINDOWED_PIXELS:
            return list(range(len(self.visits)))
        ends = [
            (level.factor * (tile.y_px + tile.height_px), k)
            for k, (level, tile) in enumerate(self.visits)
        ]
        return [k for _, k in sorted(ends)]

    def _read(self, tiles: Sequence[int]) -> Iterator[tuple[int, PreparedTile]]:
        """Yield prepared tiles; the next one is read and prepared while the caller works on this one."""

        def read_one(k: int) -> PreparedTile:
            level, tile = self.visits[k]
            return self._detector.prepared(read_reduced_window(self._raster, tile, level.factor))

        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(read_one, tiles[0])
            for k, following in zip(tiles, [*tiles[1:], None], strict=True):
                tile = ahead.result()
                if following is not None:
                    ahead = reader.submit(read_one, following)
                yield k, tile

    def _visit(self, k: int, prepared: PreparedTile) -> int:
        """Detect objects in a tile; return its number of vehicles."""
        level, tile = self.visits[k]
        seen = self._detect(prepared, level)
        vehicles, others = (
            _in_image(found, tile, level, self._overlap_px)
            for found in (seen.vehicles, seen.others)
        )
        self._found[k] = seen._replace(vehicles=vehicles, others=others)
        return self._count(vehicles)

    def _detect(self, prepared: PreparedTile, level: SearchLevel) -> TileDetections:
        """Detect vehicles of the level's lengths in a tile, rescored by the verifier, and other objects."""
        verifier = self._verifier
        # The verifier can raise the score of a weak detection.
        least = min(self._min_score, verifier.card.least_score) if verifier else self._least_score
        seen = self._detector.detect_tile(prepared, least)
        vehicles = seen.vehicles.take(level.counts(seen.vehicles.boxes[:, 2]))
        if verifier:
            candidates = len(vehicles)
            if self._pause is not None:  # in small images all vehicles are counted
                most = _MOST_VERIFIED if self.n_vehicles < _MANY_VEHICLES else _LEAST_VERIFIED
                vehicles = vehicles.take(position_sample(vehicles.boxes, most))
            self._n_skipped += candidates - len(vehicles)
            size_odds = (
                0.0
                if self._prior is None
                else self._prior.size_odds(vehicles.boxes[:, 2] * level.factor)
            )
            vehicles = verifier.scored(prepared.pixels, vehicles, size_odds=size_odds)
        vehicles = vehicles.take(vehicles.scores >= self._least_score)
        # The range of lengths applies to vehicles only.
        return seen._replace(
            vehicles=vehicles, others=seen.others.take(seen.others.scores >= self._min_score)
        )

    def result(self, *, ended: bool = True, check_stretch: bool = True) -> Detections:
        """Merge the detections of all visited tiles, independent of the order of the visits.

        Args:
            ended: whether the search has ended; before, the chip network is not asked.
            check_stretch: whether to test that width and height have one scale; a running camera
                needs it now and then.
        """
        parts = [self._found[k] for k in sorted(self._found)]
        visited = [self.visits[k][0].factor for k in sorted(self._found)]
        factors = np.repeat(visited, [len(part.vehicles) for part in parts])
        vehicles = Objects.joined([part.vehicles for part in parts])
        kept = _merged(vehicles, self._min_score, self._nms_iou)
        few = len(kept) <= _FEW_VEHICLES
        appearance = None
        if ended and self._chips:
            if few:
                kept = _merged(vehicles, self._least_score, self._nms_iou)[:_MOST_CANDIDATES]
            factors = factors[kept]
            vehicles, appearance = with_appearance(
                self._chips, self._raster, vehicles.take(kept), most=_MOST_LOOKED_AT, mirrored=few
            )
            kept = _merged(vehicles, self._min_score, self._nms_iou)
            kept = kept[np.argsort(kept >= len(appearance), kind="stable")]
            appearance = appearance.take(kept[kept < len(appearance)])
        vehicles = vehicles.take(kept)
        return Detections(
            vehicles.boxes,
            vehicles.scores,
            n_tiles=len(parts),
            n_capped_tiles=sum(part.ran_out for part in parts),
            reductions=1 / factors[kept] if self._search_scales else None,
            appearance=appearance,
            others=_merged_by_class(Objects.joined([part.others for part in parts]), self._nms_iou),
            n_tiles_total=len(self.visits),
            stopped_because=self._because,
            stretch=self._stretch(vehicles.boxes, few=few) if check_stretch else None,
            n_skipped=self._n_skipped,
        )

    def _stretch(self, boxes: NDArray[np.float64], *, few: bool) -> float | None:
        """Ask a network that scored the vehicles whether the image is stretched; None without any."""
        if few and self._chips:
            return stretch_of_few(self._raster, boxes, self._chips)
        return stretch(self._raster, boxes, self._verifier) if self._verifier else None


def _merged(vehicles: Objects, min_score: float, nms_iou: float) -> NDArray[np.intp]:
    """Suppress non-maximum vehicles with a sufficient score; return the indices of the others, best first."""
    enough = np.flatnonzero(vehicles.scores >= min_score)
    return enough[
        oriented_nms(vehicles.boxes[enough], vehicles.scores[enough], iou_threshold=nms_iou)
    ]


def _tile_and_stride(fixed_size: tuple[int, int] | None, options: Search) -> tuple[int, int]:
    """Choose the side of the tiles and their stride, pixels."""
    tile_px = options.tile_px
    if tile_px is None:
        tile_px = min(fixed_size) if fixed_size else TILE_SIZE_PX
    if fixed_size and tile_px > min(fixed_size):
        raise InvalidParameterError(
            f"tile_px is {tile_px}, but the model's input is fixed at {fixed_size}"
        )
    stride_px = (
        round(tile_px * (1 - TILE_OVERLAP)) if options.stride_px is None else options.stride_px
    )
    if tile_px < _MIN_TILE_PX or not 1 <= stride_px <= tile_px:
        raise InvalidParameterError(
            f"tile_px {tile_px}, stride_px {stride_px}: use a tile >= {_MIN_TILE_PX} and a "
            "stride within it"
        )
    return tile_px, stride_px


def _in_image(found: Objects, tile: Window, level: SearchLevel, overlap_px: int) -> Objects:
    """Convert a tile's objects to pixels of the image, without those that its inner edges cut.

    The next tile shows these completely, unless they are longer than the overlap.
    """
    corners = box_corners(found.boxes)
    corner = np.array([tile.x_px, tile.y_px])
    size = np.array([tile.width_px, tile.height_px])
    cut = (corners.min(axis=1) < 1) & (corner > 0)
    cut |= (corners.max(axis=1) > size - 1) & (corner + size < (level.width_px, level.height_px))
    whole = found.take(~(cut.any(axis=1) & (found.boxes[:, 2] < overlap_px)))
    boxes = whole.boxes.copy()
    boxes[:, :2] += corner
    boxes[:, :4] *= level.factor
    return Objects(boxes, whole.scores, whole.classes)


def _merged_by_class(found: Objects, nms_iou: float) -> Objects:
    """Suppress non-maximum objects within each class; the result is sorted by falling score, then by class."""
    parts = []
    for index in np.unique(found.classes):
        members = found.take(found.classes == index)
        parts.append(
            members.take(oriented_nms(members.boxes, members.scores, iou_threshold=nms_iou))
        )
    merged = Objects.joined(parts)
    return merged.take(np.argsort(-merged.scores, kind="stable"))
