"""Measure optional stopping.

``python -m research.benchmarks.stopping --data FOLDER``. Prints Markdown; ``--record`` keeps it.

Each val image is searched once. Mosaics of 0.2 m/px are then made from its detections, towns with
fields between them, and searched with the real order of tiles and the real rule. Fleets differ from
mosaic to mosaic as much as reference lengths do. Many mosaics take minutes only, because their
pixels are not searched (``gigapixel.py`` does that for a few).
"""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from research.benchmarks.gigapixel import CELL_PX, GSD_M, SETS, layout, pictures
from research.results.record import add_record_option, header, recording
from vehanchor.analysis.convergence import convergence, has_converged, stop_rule
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.detector import load_detector
from vehanchor.detection.levels import level_shares, search_levels
from vehanchor.detection.scheduler import (
    LARGE_PIXELS,
    TileScheduler,
    first_pause,
    most_tiles,
    next_pause,
)
from vehanchor.detection.search import ImageSearch
from vehanchor.detection.tile_prior import car_prior, tile_prior_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import tile_grid
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions, Search
from vehanchor.rulers.ruler import View
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.density import lognormal
from vehanchor.scale.posterior import answer

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Window

# Spread of the log of the scene-scale prior.
_SCENE_LOG_SD = 0.25
# Vehicles with a measured appearance, as in a search.
_MAX_APPEARANCES = 64


class Cell(NamedTuple):
    """Detections of a 512 px piece of a val image."""

    boxes: NDArray[Any]
    scores: NDArray[Any]
    appearance: Appearance
    tile_prior: float


def searched(images: list[NDArray[Any]], detector: Detector) -> list[Cell]:
    """Search the upper left 512 px of each image at full resolution."""
    cells = []
    for image in images:
        missing = [(0, max(0, CELL_PX - side)) for side in image.shape[:2]]
        image = np.pad(image, [*missing, (0, 0)], "symmetric")
        image = np.ascontiguousarray(image[:CELL_PX, :CELL_PX, ::-1])
        with open_raster(image) as raster:
            vehicles = ImageSearch(raster, detector, Search(search_scales=False)).searched()
        n = len(vehicles.boxes)
        appearance = Appearance(*(np.zeros(0) for _ in Appearance._fields))
        if n and vehicles.appearance is not None:
            # Vehicles beyond the measured ones get the appearance of others in the cell.
            indices = np.arange(n) % len(vehicles.appearance)
            appearance = vehicles.appearance.take(indices)
        side = CELL_PX // 8
        coarse = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
        tile_prior = car_prior(np.asarray(coarse, np.uint8), detector.card.errors.tile_prior).item()
        cell = Cell(vehicles.boxes, vehicles.scores, appearance=appearance, tile_prior=tile_prior)
        cells.append(cell)
    return cells


class Mosaic:
    """Cells in rows and columns, with their detections and tile priors.

    Args:
        side: pixels.
        towns: cells with cars.
        fields: cells without cars.
        share: share of the area in towns.
        factor: length of this fleet over the length of the cells' own cars.
        rng: random numbers.
    """

    def __init__(
        self,
        side: int,
        towns: list[Cell],
        fields: list[Cell],
        share: float,
        factor: float,
        rng: Generator,
    ) -> None:
        is_town = layout(side // CELL_PX, share, rng)
        cells = []
        boxes = []
        for row, towns_of_row in enumerate(is_town):
            for column, town in enumerate(towns_of_row):
                pool = towns if town else fields
                cell = pool[rng.integers(len(pool))]
                cells.append(cell)
                offset = [column * CELL_PX, row * CELL_PX, 0, 0, 0]
                boxes.append(cell.boxes * [1, 1, factor, factor, 1] + offset)
        tile_priors = np.array([cell.tile_prior for cell in cells])
        self.tile_prior = tile_priors.reshape(is_town.shape)
        self.boxes = np.concatenate(boxes)
        self.scores = np.concatenate([cell.scores for cell in cells])
        self.appearance = Appearance.joined([cell.appearance for cell in cells])
        self.side = side

    def detections(self, is_found: NDArray[Any]) -> Detections:
        """Collect the detections of a search that has found these boxes, best first."""
        found = np.flatnonzero(is_found)
        found = found[np.argsort(-self.scores[found], kind="stable")]
        appearance = self.appearance.take(found[:_MAX_APPEARANCES])
        return Detections(
            self.boxes[found],
            self.scores[found],
            reductions=np.ones(len(found)),
            appearance=appearance,
        )


class Outcome(NamedTuple):
    """One search of one mosaic."""

    share: float
    gsd: float
    covered: bool
    converged: bool


def outcome(mosaic: Mosaic, detector: Detector, options: ScaleOptions) -> Outcome:
    """Search a mosaic with the real order of tiles and the real rule."""
    side = mosaic.side
    tiles, scheduler = _schedule(mosaic, detector)
    n_pixels = max(side * side, LARGE_PIXELS)
    rule = stop_rule(options.search.effort, n_pixels)
    view = partial(
        View,
        ImageFacts(side, side),
        card=detector.card,
        options=options,
        measure_detail_share=lambda *_: 1.0,
    )
    is_found = np.zeros(len(mosaic.boxes), bool)
    checks = []
    max_tiles = most_tiles(options.search, n_pixels, len(tiles))
    n_visited = 0
    next_check = first_pause(options.search, n_pixels)
    converged = False
    while n_visited < max_tiles and not converged:
        for k in scheduler.next_tiles(min(4, max_tiles - n_visited)):
            factor, tile = tiles[k]
            n_new = 0
            # Cars are found at full resolution, if their centre is not at the tile's edge.
            if factor == 1:
                centre = [tile.x_px + 512, tile.y_px + 512]
                is_inside = np.abs(mosaic.boxes[:, :2] - centre).max(axis=1) < 505
                n_new = int(is_inside.sum())
                is_found |= is_inside
            scheduler.report(k, n_new)
            n_visited += 1
        if next_check is not None and next_check <= n_visited < max_tiles:
            next_check = next_pause(n_visited)
            checks.append(convergence(view(detections=mosaic.detections(is_found))))
            converged = has_converged(checks, rule)
    share = n_visited / len(tiles)
    scale = answer([Vehicles().measure(view(detections=mosaic.detections(is_found)))])
    if scale is None:
        return Outcome(share, math.nan, covered=False, converged=converged)
    covered = scale.interval.low <= GSD_M <= scale.interval.high
    return Outcome(share, scale.gsd_m_per_px, covered=covered, converged=converged)


def _schedule(mosaic: Mosaic, detector: Detector) -> tuple[list[tuple[int, Window]], TileScheduler]:
    """List the tiles of all levels with their factors, and order them by the tile priors."""
    side = mosaic.side
    shortest_px, longest_px = detector.card.length_range_px
    levels = search_levels(side, side, (shortest_px, longest_px), search_scales=True)
    tiles = [
        (level.factor, tile)
        for level in levels
        for tile in tile_grid(level.width_px, level.height_px)
    ]
    ranges = {
        level.factor: (max(shortest_px, level.shortest_px), level.longest_px) for level in levels
    }
    priors = np.array([tile_prior_of(mosaic.tile_prior, tile, factor) for factor, tile in tiles])
    shares = level_shares(ranges, lognormal(GSD_M, _SCENE_LOG_SD))
    return tiles, TileScheduler(tiles, priors, shares)


def main() -> None:
    """Print one row for each effort."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--mosaics", type=int, default=300)
    parser.add_argument("--side", type=int, default=8192)
    arguments = add_record_option(parser).parse_args()
    detector = load_detector(resolve_model(None))
    towns = {
        name: searched(pictures(arguments.data, name, table), detector)
        for name, table in SETS.items()
    }
    fields = searched(pictures(arguments.data, "empty", "table.csv"), detector)
    results: dict[str, list[Outcome]] = {"full": [], "auto": [], "fast": []}
    for seed in range(arguments.mosaics):
        rng = np.random.default_rng(seed)
        name = sorted(towns)[seed % len(towns)]
        # The part of the fleet's length that its appearance does not show.
        factor = math.exp(rng.normal(0, detector.card.errors.appearance.log_sd))
        mosaic = Mosaic(
            arguments.side,
            towns[name],
            fields=fields,
            share=rng.uniform(0.05, 0.4),
            factor=factor,
            rng=rng,
        )
        for effort, outcomes in results.items():
            outcomes.append(outcome(mosaic, detector, ScaleOptions.of({"effort": effort})))
    full = np.array([result.gsd for result in results["full"]])
    columns = [
        "effort",
        "cover of the 95 % interval",
        "tiles, median",
        "ended early",
        "difference to `full`: median",
        "95th percentile",
    ]
    with recording("speed", ["stopping"], arguments.record):
        print(header(*columns))
        for effort, outcomes in results.items():
            gsd = np.array([result.gsd for result in outcomes])
            difference = np.abs(np.log(gsd / full))
            cells = [
                effort,
                f"{np.mean([result.covered for result in outcomes]):.1%}",
                f"{np.median([result.share for result in outcomes]):.1%}",
                f"{np.mean([result.converged for result in outcomes]):.0%}",
                f"{np.nanmedian(difference):.2%}",
                f"{np.nanpercentile(difference, 95):.1%}",
            ]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
