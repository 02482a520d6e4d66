"""Search of an image: the detector's vehicles in overlapping tiles, merged into one ``Detections``.

1. *Levels*: tiles cover the image at full resolution and, if the model searches scales, at 1/2, 1/4
   and 1/8. A car that is too long for the detector at one level fits the next one.
2. *Order*: tiles in which cars are likely come first. Levels at which the scene-scale prior
   excludes cars come last, and only if the others show few vehicles.
3. *Tiles*: the detector proposes candidates, and the verifier scores them again. In crowded tiles
   of large images it scores a sample.
4. *Pauses*: at growing intervals the search yields to its caller, which knows what the vehicles say
   about the scale. The caller leaves out levels, or ends the search when more tiles cannot change
   the scale.
5. *Merging*: overlapping tiles and neighbouring levels show the same vehicle. Non-maximum
   suppression keeps its best box.
6. *Appearance*: at the end the chip network scores the best vehicles again and replaces their boxes
   by those of their bodies. If they are few, it examines weaker candidates, too. In the place of
   drawn things, such as letters, it examines the next vehicles.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import oriented_iou
from vehanchor.detection.chips import with_appearance
from vehanchor.detection.detections import Detections, Objects
from vehanchor.detection.levels import level_chances, level_shares, search_levels
from vehanchor.detection.merging import distinct_by_class, distinct_vehicles
from vehanchor.detection.proportions import stretch, stretch_log_odds, stretch_of_few
from vehanchor.detection.scheduler import (
    LARGE_PIXELS,
    WINDOWED_PIXELS,
    TileScheduler,
    first_pause,
    most_tiles,
    next_pause,
)
from vehanchor.detection.tile_prior import tile_prior_map, tile_prior_of
from vehanchor.detection.tile_search import MinScores, Tile, TileSearch
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.axis_detail import measure_detail_difference
from vehanchor.imagery.tiles import TILE_OVERLAP, TILE_SIZE_PX, read_reduced_window, tile_grid
from vehanchor.options import Search
from vehanchor.scale.reliability import detail_likelihoods

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.chips import ChipNetwork, Examined
    from vehanchor.detection.detections import Appearance
    from vehanchor.detection.detector import Detector, PreparedTile, TileDetections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor.scale.defaults import Stopped
    from vehanchor.scale.density import Density

_MIN_TILE_PX = 32
# Tiles that are scheduled together; each is read while the model runs on the one before.
_TILES_AT_ONCE = 4

# Chance of cars at a level below which the level comes last. The prior's floor alone gives nearly
# as much.
_MIN_LEVEL_CHANCE = 0.01
# Number of vehicles at the likely levels that makes the unlikely ones superfluous. With fewer, the
# prior may be wrong.
_ENOUGH_VEHICLES = 5
# Chance of cars at a level, by the vehicles found so far, below which the level is left out. One
# clear car elsewhere leaves 2 to 3 %.
_EXCLUDED_CHANCE = 0.03

# Candidates that the verifier scores in a tile of a large image. More cost as much as another tile
# and add less.
_MAX_VERIFIED = 128
# From this number of vehicles on, the scale hardly changes, and a smaller sample suffices.
_MANY_VEHICLES = 500
_MAX_VERIFIED_OF_MANY = 32

# Vehicles that the chip network examines; 100 give the same answers to 1,957 photographs.
_MAX_WITH_APPEARANCE = 64
# Up to this number of vehicles, it also examines weaker candidates, and mirrored chips.
_FEW_VEHICLES = 12
_MAX_CANDIDATES = 24
# Chance from which a candidate counts as drawn. A choice: few have chances of 0.1 to 0.9.
_DRAWN_CHANCE = 0.5
# Times that the network examines other candidates in the places of drawn ones; a page of text has
# hundreds. A choice.
_MAX_ROUNDS = 4


class _FinalVehicles(NamedTuple):
    """Distinct vehicles, reduction factors of their levels, and appearance of the first ones."""

    vehicles: Objects
    factors: NDArray[np.intp]
    appearance: Appearance | None


class ImageSearch:
    """Search of an image (paper, section III-B), which visits tiles while it is iterated over.

    An iteration yields the expected share of the vehicles in the tiles that are not visited, at
    growing intervals; its caller may then ask for the ``result`` so far, ``leave_out`` levels, or
    ``stop``.

    Args:
        raster: the image, or a part of one; at most two of its tiles are in memory.
        detector: the model; the search reports its tiles to the progress of the detector's runtime.
        options: how to search; None for the defaults.
        prior: scene-scale prior, which orders the levels and weighs the boxes' sizes; None without
            one.

    Attributes:
        n_vehicles: number of vehicles found so far, before duplicates are merged.

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
        self._raster = raster
        self._detector = detector
        self._prior = prior
        self._nms_iou = options.nms_iou
        self._verifier = None
        self._chips = None
        if options.verify:
            self._verifier = detector.verifier
            self._chips = detector.chips
        self._min_scores = _min_scores(detector, options)

        card = detector.card
        self._min_length_px, _ = card.length_range_px
        self._search_scales = card.search_scales
        if options.search_scales is not None:
            self._search_scales = options.search_scales
        tile_px, stride_px = _tile_and_stride(detector.fixed_size, options)
        self._levels = search_levels(
            raster.width_px,
            raster.height_px,
            card.length_range_px,
            search_scales=self._search_scales,
        )
        self._tiles: list[Tile] = []
        for level in self._levels:
            windows = tile_grid(
                level.width_px,
                level.height_px,
                tile_px=tile_px,
                stride_px=stride_px,
            )
            self._tiles += [Tile(level, window) for window in windows]

        self._n_pixels = raster.width_px * raster.height_px
        self._is_full = options.effort == "full"
        self._max_tiles = most_tiles(options, self._n_pixels, len(self._tiles))
        self._max_seconds = options.max_seconds or math.inf
        self._next_pause = first_pause(options, self._n_pixels)

        self._tile_search = TileSearch(
            detector,
            self._verifier,
            prior=prior,
            min_scores=self._min_scores,
            overlap_px=tile_px - stride_px,
        )
        self._results: dict[int, TileDetections] = {}
        self.n_vehicles = 0
        self._left_out: frozenset[int] = frozenset()
        self._stopped_because: Stopped | None = None

    @property
    def n_visited(self) -> int:
        """Number of visited tiles."""
        return len(self._results)

    def __iter__(self) -> Iterator[float]:
        """Visit tiles until the limits or the caller end the search."""
        n_tiles = len(self._tiles)
        is_unlimited = self._max_tiles == n_tiles and self._max_seconds == math.inf
        if self._is_full and is_unlimited:
            self._visit_all()
        else:
            yield from self._visit_likely_first()
        if self._stopped_because is None:
            self._stopped_because = self._exhausted_limit()
        self._detector.runtime.report_progress(n_tiles, n_tiles)

    def searched(self) -> Detections:
        """Visit tiles to the limits of the options, and merge what they show."""
        for _ in self:
            pass
        return self.result()

    def stop(self) -> None:
        """End the search: more tiles cannot change the scale."""
        self._stopped_because = "converged"

    def leave_out(self, density: Density) -> None:
        """Leave out the levels that the scale found so far makes superfluous; none without a prior.

        At such a level cars have a length that the detector does not know. In a photograph, a level
        is superfluous, too, if a finer one accepts the same cars. In larger images it is not: few
        tiles are visited, and those of a coarse level show more cars.

        Args:
            density: ``[g]`` of the scale on ``vehanchor.scale.density.GRID``.
        """
        if self._prior is None:
            return
        ranges = self._length_ranges_px()
        if self._n_pixels < LARGE_PIXELS:
            for level in self._levels:
                shortest, longest = ranges[level.factor]
                ranges[level.factor] = max(shortest, level.shortest_own_px), longest
        chances = level_chances(ranges, density)
        self._left_out = frozenset(
            factor for factor, chance in chances.items() if chance < _EXCLUDED_CHANCE
        )

    def result(self, *, ended: bool = True, check_stretch: bool = True) -> Detections:
        """Merge the detections of all visited tiles, independent of the order of the visits.

        They are in pixels of the image, if a part of it was searched, too.

        Args:
            ended: whether the search has ended; before, the chip network is not asked.
            check_stretch: whether to test that width and height have one scale; a running camera
                needs it now and then.
        """
        visited = sorted(self._results)
        parts = [self._results[index] for index in visited]
        factor_of_part = [self._tiles[index].level.factor for index in visited]
        n_of_part = [len(part.vehicles) for part in parts]
        factors = np.repeat(factor_of_part, n_of_part)
        candidates = Objects.joined([part.vehicles for part in parts])
        others = Objects.joined([part.others for part in parts])

        kept = distinct_vehicles(candidates, self._min_scores.vehicle, self._nms_iou)
        are_few = len(kept) <= _FEW_VEHICLES
        if ended and self._chips:
            final = self._with_appearance(self._chips, candidates, factors=factors, kept=kept)
        else:
            final = _FinalVehicles(candidates.take(kept), factors[kept], None)

        reductions = None
        if self._search_scales:
            reductions = 1 / final.factors
        stretch_share = None
        stretch_odds = None
        if check_stretch:
            stretch_share = self._stretch(final.vehicles.boxes, are_few=are_few)
            stretch_odds = self._stretch_log_odds(final)
        detections = Detections(
            final.vehicles.boxes,
            final.vehicles.scores,
            n_tiles=len(parts),
            n_capped_tiles=sum(part.ran_out for part in parts),
            reductions=reductions,
            appearance=final.appearance,
            others=distinct_by_class(others, self._nms_iou),
            n_tiles_total=len(self._tiles),
            stopped_because=self._stopped_because,
            stretch=stretch_share,
            stretch_log_odds=stretch_odds,
            n_skipped=self._tile_search.n_skipped,
        )
        return detections.moved(self._raster.origin_px)

    def _visit_all(self) -> None:
        """Visit all tiles."""
        order = self._reading_order()
        for index, tile in self._read_ahead(order):
            self._detector.runtime.report_progress(self.n_visited, len(order))
            self._visit(index, tile)

    def _visit_likely_first(self) -> Iterator[float]:
        """Visit likely levels and tiles first, until the limits or the caller end the search."""
        deadline = time.monotonic() + self._max_seconds
        for factors in self._levels_by_chance():
            if self.n_visited >= self._max_tiles:
                return
            # Unlikely levels are visited only if the likely ones show few vehicles.
            if self.n_visited and self.n_vehicles >= _ENOUGH_VEHICLES:
                self.stop()
                return
            yield from self._visit_levels(factors, deadline)
            if self._stopped_because is not None:
                return

    def _visit_levels(self, factors: Collection[int], deadline: float) -> Iterator[float]:
        """Visit the tiles of some levels, likely ones first, with pauses."""
        scheduler = self._scheduler(factors)
        # After other levels, the caller may already know enough.
        is_pause_due = self._next_pause is not None and self.n_visited > 0
        while True:
            if is_pause_due:
                yield scheduler.unseen_share
                if self._stopped_because is not None:
                    return
                scheduler.leave_out(self._left_out)
            n_left = self._max_tiles - self.n_visited
            batch = scheduler.next_tiles(min(_TILES_AT_ONCE, n_left))
            if not batch:
                return
            for index, tile in self._read_ahead(batch):
                # One tile is visited whatever the limit: without any, there is no answer.
                if self.n_visited and time.monotonic() > deadline:
                    self._stopped_because = "max_seconds"
                    return
                self._detector.runtime.report_progress(self.n_visited, len(self._tiles))
                n_vehicles = self._visit(index, tile)
                scheduler.report(index, n_vehicles)
            is_pause_due = self._take_pause()

    def _take_pause(self) -> bool:
        """Test whether a pause is due; if it is, schedule the next one."""
        if self._next_pause is None:
            return False
        if not self._next_pause <= self.n_visited < self._max_tiles:
            return False
        self._next_pause = next_pause(self.n_visited)
        return True

    def _exhausted_limit(self) -> Stopped:
        """Name the reason for the end of a search that ran out of tiles."""
        if self.n_visited == len(self._tiles):
            return "all_searched"
        if self.n_visited == self._max_tiles:
            return "max_tiles"
        # Only tiles of superfluous levels are left.
        return "converged"

    def _levels_by_chance(self) -> list[frozenset[int]]:
        """Group the levels: those that may show cars, then those where the prior excludes cars."""
        ranges = self._length_ranges_px()
        everything = frozenset(ranges)
        if self._prior is None or self._is_full:
            return [everything]
        chances = level_chances(ranges, self._prior.density)
        likely = frozenset(
            factor for factor, chance in chances.items() if chance >= _MIN_LEVEL_CHANCE
        )
        return [group for group in (likely, everything - likely) if group]

    def _length_ranges_px(self) -> dict[int, tuple[float, float]]:
        """Give the shortest and the longest vehicle of each level, pixels of its image."""
        ranges = {}
        for level in self._levels:
            shortest_px = max(self._min_length_px, level.shortest_px)
            ranges[level.factor] = shortest_px, level.longest_px
        return ranges

    def _scheduler(self, factors: Collection[int]) -> TileScheduler:
        """Schedule the tiles of some levels by the tile prior and the scene-scale prior."""
        tiles = [(tile.level.factor, tile.window) for tile in self._tiles]
        cells = self._tile_priors
        priors = [tile_prior_of(cells, window, factor) for factor, window in tiles]
        density = None
        if self._prior is not None:
            density = self._prior.density
        ranges = self._length_ranges_px()
        scheduled = {factor: ranges[factor] for factor in ranges if factor in factors}
        shares = level_shares(scheduled, density)
        return TileScheduler(tiles, np.array(priors), shares)

    @cached_property
    def _tile_priors(self) -> NDArray[np.float64]:
        """Probability that each cell of the image shows cars."""
        return tile_prior_map(self._raster, self._detector.card.errors.tile_prior)

    def _reading_order(self) -> list[int]:
        """List all tiles in the order in which the image is decoded fewest times.

        In a large image a coarse tile follows the fine ones under it, which are still decoded.
        """
        indices = list(range(len(self._tiles)))
        if self._n_pixels < WINDOWED_PIXELS:
            return indices

        def bottom_px(index: int) -> int:
            level, window = self._tiles[index]
            return level.factor * (window.y_px + window.height_px)

        return sorted(indices, key=bottom_px)

    def _read_ahead(self, indices: Sequence[int]) -> Iterator[tuple[int, PreparedTile]]:
        """Yield prepared tiles; a thread prepares the next while the caller works on this one.

        A search of one thread, such as a worker's beside others, prepares none ahead: the other
        cores are theirs, and the tile takes 13 MB.
        """
        if self._detector.runtime.threads == 1:
            for index in indices:
                yield index, self._prepare(index)
            return
        with ThreadPoolExecutor(1) as reader:
            ahead = reader.submit(self._prepare, indices[0])
            for position, index in enumerate(indices, 1):
                tile = ahead.result()
                if position < len(indices):
                    ahead = reader.submit(self._prepare, indices[position])
                yield index, tile

    def _prepare(self, index: int) -> PreparedTile:
        """Read a tile and convert it to the detector's input."""
        level, window = self._tiles[index]
        pixels = read_reduced_window(self._raster, window, level.factor)
        return self._detector.prepared(pixels)

    def _visit(self, index: int, prepared: PreparedTile) -> int:
        """Detect objects in a tile; return its number of vehicles."""
        max_verified = self._max_verified()
        detections = self._tile_search.detect(prepared, self._tiles[index], max_verified)
        self._results[index] = detections
        scores = detections.vehicles.scores
        n_vehicles = int(np.count_nonzero(scores >= self._min_scores.vehicle))
        self.n_vehicles += n_vehicles
        return n_vehicles

    def _max_verified(self) -> int | None:
        """Limit the candidates of a tile that the verifier scores; None for no limit."""
        # A search without pauses counts all vehicles.
        if self._next_pause is None:
            return None
        if self.n_vehicles < _MANY_VEHICLES:
            return _MAX_VERIFIED
        return _MAX_VERIFIED_OF_MANY

    def _with_appearance(
        self,
        network: ChipNetwork,
        candidates: Objects,
        factors: NDArray[np.intp],
        kept: NDArray[np.intp],
    ) -> _FinalVehicles:
        """Score vehicles again by the chip network, and replace their boxes by those of bodies.

        Args:
            network: the chip network.
            candidates: ``[n]`` vehicles of all tiles.
            factors: ``[n]`` reduction factors of their levels.
            kept: indices of the distinct vehicles, best first.

        Returns:
            The distinct vehicles, those with an appearance first.
        """
        kept, examined = self._examined(network, candidates, kept)
        # Letters take the places of cars: without them, the network examines the next candidates.
        for _ in range(_MAX_ROUNDS):
            is_drawn = examined.drawn_chances >= _DRAWN_CHANCE
            first = kept[: len(is_drawn)]
            # A weak candidate takes no place.
            is_drawn &= candidates.scores[first] >= self._min_scores.vehicle
            if not is_drawn.any():
                break
            overlaps = oriented_iou(candidates.boxes, candidates.boxes[first[is_drawn]])
            photographed = np.flatnonzero((overlaps <= self._nms_iou).all(axis=1))
            candidates = candidates.take(photographed)
            factors = factors[photographed]
            kept = distinct_vehicles(candidates, self._min_scores.vehicle, self._nms_iou)
            kept, examined = self._examined(network, candidates, kept)
        vehicles = examined.candidates
        appearance = examined.appearance
        # New boxes may overlap, and new scores may be too low.
        best = distinct_vehicles(vehicles, self._min_scores.vehicle, self._nms_iou)
        has_appearance = best < len(appearance)
        with_one = best[has_appearance]
        others = best[~has_appearance]
        best = np.concatenate([with_one, others])
        return _FinalVehicles(
            vehicles.take(best),
            factors[kept][best],
            appearance.take(with_one),
        )

    def _examined(
        self, network: ChipNetwork, candidates: Objects, kept: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], Examined]:
        """Let the chip network examine the distinct vehicles; weaker ones, too, if they are few.

        Returns:
            Indices of the examined candidates and of further vehicles, best first; their boxes and
            scores by the network.
        """
        are_few = len(kept) <= _FEW_VEHICLES
        if are_few:
            kept = distinct_vehicles(candidates, self._min_scores.candidate, self._nms_iou)
            kept = kept[:_MAX_CANDIDATES]
        examined = with_appearance(
            network,
            self._raster,
            candidates.take(kept),
            most=_MAX_WITH_APPEARANCE,
            mirrored=are_few,
        )
        return kept, examined

    def _stretch(self, boxes: NDArray[np.float64], *, are_few: bool) -> float | None:
        """Ask a network that scored the vehicles whether the image is stretched."""
        limits = self._detector.card.errors.stretch
        if are_few and self._chips:
            return stretch_of_few(self._raster, boxes, self._chips, limits)
        if self._verifier:
            return stretch(self._raster, boxes, self._verifier, limits)
        return None

    def _stretch_log_odds(self, final: _FinalVehicles) -> float | None:
        """Ask networks and detail for the odds of a stretch; None without both networks."""
        if final.appearance is None or not self._chips or not self._verifier:
            return None
        return stretch_log_odds(
            self._raster,
            final.vehicles.boxes,
            final.appearance.logits,
            chip_network=self._chips,
            network=self._verifier,
            errors=self._detector.card.errors.stretch_odds,
            detail=detail_likelihoods(measure_detail_difference(self._raster)),
        )


def _min_scores(detector: Detector, options: Search) -> MinScores:
    """Choose the lowest scores by the options and the cards of the networks."""
    vehicle = detector.card.min_score
    if options.min_score is not None:
        vehicle = options.min_score
    candidate = vehicle
    proposal = vehicle
    if options.verify and detector.chips:
        candidate = min(vehicle, detector.chips.card.least_score)
        proposal = candidate
    if options.verify and detector.verifier:
        proposal = min(vehicle, detector.verifier.card.least_score)
    return MinScores(proposal=proposal, candidate=candidate, vehicle=vehicle)


def _tile_and_stride(fixed_size: tuple[int, int] | None, options: Search) -> tuple[int, int]:
    """Choose the side of the tiles and their stride, pixels."""
    tile_px = options.tile_px
    if tile_px is None:
        tile_px = TILE_SIZE_PX
        if fixed_size:
            tile_px = min(fixed_size)
    if fixed_size and tile_px > min(fixed_size):
        raise InvalidParameterError(
            f"tile_px is {tile_px}, but the model's input is fixed at {fixed_size}"
        )
    stride_px = options.stride_px
    if stride_px is None:
        stride_px = round(tile_px * (1 - TILE_OVERLAP))
    if tile_px < _MIN_TILE_PX or not 1 <= stride_px <= tile_px:
        raise InvalidParameterError(
            f"tile_px {tile_px}, stride_px {stride_px}: use a tile >= {_MIN_TILE_PX} and a "
            "stride within it"
        )
    return tile_px, stride_px
