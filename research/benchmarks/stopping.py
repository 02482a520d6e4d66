"""Measure optional stopping.

``python -m research.benchmarks.stopping --data FOLDER``. Prints Markdown; ``--record`` keeps it.

Each val image is searched once; mosaics of 0.2 m/px are then laid out of what was found in them,
towns with fields between, and searched by the real order and rule. Fleets differ from mosaic to
mosaic as much as the reference length says they do. So many mosaics take minutes: no pixel of them
is looked at (``gigapixel.py`` does that for a few).
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
    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector

_SCENE_LOG_SD = 0.25  # of what the ground says
_LOOKED_AT = 64  # vehicles whose looks are known, as in a search


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
        image = np.pad(
            image, [(0, max(0, CELL_PX - side)) for side in image.shape[:2]] + [(0, 0)], "symmetric"
        )
        image = np.ascontiguousarray(image[:CELL_PX, :CELL_PX, ::-1])
        with open_raster(image) as raster:
            found = ImageSearch(raster, detector, Search(search_scales=False)).searched()
        n = len(found.boxes)
        appearance = Appearance(*(np.zeros(0) for _ in Appearance._fields))
        if n and found.appearance is not None:
            # beyond the first, those of others in the cell
            appearance = found.appearance.take(np.arange(n) % len(found.appearance))
        coarse = np.asarray(
            cv2.resize(image, (CELL_PX // 8,) * 2, interpolation=cv2.INTER_AREA), np.uint8
        )
        cells.append(
            Cell(
                found.boxes,
                found.scores,
                appearance=appearance,
                tile_prior=car_prior(coarse, detector.card.errors.tile_prior).item(),
            )
        )
    return cells


class Mosaic:
    """Cells laid out, and the tiles through which they are found.

    Args:
        side: pixels.
        towns: cells with cars.
        fields: cells without.
        share: of the area in towns.
        factor: by which this fleet is longer than the cells' own.
        rng: chooses.
    """

    def __init__(
        self,
        side: int,
        towns: list[Cell],
        fields: list[Cell],
        share: float,
        factor: float,
        rng: np.random.Generator,
    ) -> None:
        n = side // CELL_PX
        where = layout(n, share, rng)
        chosen = [
            [
                among[rng.integers(len(among))]
                for among in (towns if town else fields for town in row)
            ]
            for row in where
        ]
        self.tile_prior = np.array([[cell.tile_prior for cell in row] for row in chosen])
        self.boxes = np.concatenate(
            [
                cell.boxes * [1, 1, factor, factor, 1] + [column * CELL_PX, row * CELL_PX, 0, 0, 0]
                for row, cells in enumerate(chosen)
                for column, cell in enumerate(cells)
            ]
        )
        flat = [cell for cells in chosen for cell in cells]
        self.scores = np.concatenate([cell.scores for cell in flat])
        self.appearance = Appearance.joined([cell.appearance for cell in flat])
        self.side = side

    def detections(self, found: NDArray[Any]) -> Detections:
        """Detections of a search that has found these boxes."""
        kept = np.flatnonzero(found)
        kept = kept[np.argsort(-self.scores[kept], kind="stable")]
        appearance = self.appearance.take(kept[:_LOOKED_AT])
        return Detections(
            self.boxes[kept],
            self.scores[kept],
            reductions=np.ones(len(kept)),
            appearance=appearance,
        )


class Outcome(NamedTuple):
    """One search of one mosaic."""

    share: float
    gsd: float
    covered: bool
    converged: bool


def outcome(mosaic: Mosaic, detector: Detector, options: ScaleOptions) -> Outcome:
    """Search a mosaic by the real order and rule."""
    card = detector.card
    side = mosaic.side
    levels = search_levels(side, side, card.length_range_px, search_scales=True)
    places = [
        (level.factor, tile)
        for level in levels
        for tile in tile_grid(level.width_px, level.height_px)
    ]
    ranges = {
        each.factor: (max(card.length_range_px[0], each.shortest_px), each.longest_px)
        for each in levels
    }
    promises = np.array([tile_prior_of(mosaic.tile_prior, tile, factor) for factor, tile in places])
    order = TileScheduler(places, promises, level_shares(ranges, lognormal(GSD_M, _SCENE_LOG_SD)))
    n_pixels = max(side * side, LARGE_PIXELS)
    rule = stop_rule(options.search.effort, n_pixels)
    view = partial(
        View,
        ImageFacts(side, side),
        card=card,
        options=options,
        measure_detail_share=lambda *_: 1.0,
    )
    found = np.zeros(len(mosaic.boxes), bool)
    visited = 0
    due = first_pause(options.search, n_pixels)
    checks = []
    most = most_tiles(options.search, n_pixels, len(places))
    done = False
    while visited < most and not done:
        for k in order.next_tiles(min(4, most - visited)):
            (factor, tile) = places[k]
            n_new = 0
            if factor == 1:
                inside = (
                    np.abs(mosaic.boxes[:, :2] - [tile.x_px + 512, tile.y_px + 512]).max(axis=1)
                    < 505
                )
                n_new = int(inside.sum())
                found |= inside
            order.report(k, n_new)
            visited += 1
        if due is not None and due <= visited < most:
            due = next_pause(visited)
            checks.append(convergence(view(detections=mosaic.detections(found))))
            done = has_converged(checks, rule)
    seen = mosaic.detections(found)
    told = answer([Vehicles().measure(view(detections=seen))])
    if told is None:
        return Outcome(visited / len(places), math.nan, False, done)
    covered = told.interval.low <= GSD_M <= told.interval.high
    return Outcome(visited / len(places), told.gsd_m_per_px, covered, done)


def main() -> None:
    """Print one row for each effort."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--mosaics", type=int, default=300)
    parser.add_argument("--side", type=int, default=8192)
    chosen = add_record_option(parser).parse_args()
    detector = load_detector(resolve_model(None))
    towns = {
        name: searched(pictures(chosen.data, name, table), detector) for name, table in SETS.items()
    }
    fields = searched(pictures(chosen.data, "empty", "table.csv"), detector)
    found: dict[str, list[Outcome]] = {"full": [], "auto": [], "fast": []}
    for seed in range(chosen.mosaics):
        rng = np.random.default_rng(seed)
        name = sorted(towns)[seed % len(towns)]
        # of this place's cars, which their looks do not tell
        factor = math.exp(rng.normal(0, detector.card.errors.appearance.log_sd))
        mosaic = Mosaic(
            chosen.side,
            towns[name],
            fields=fields,
            share=float(rng.uniform(0.05, 0.4)),
            factor=factor,
            rng=rng,
        )
        for effort, outcomes in found.items():
            outcomes.append(outcome(mosaic, detector, ScaleOptions.of({"effort": effort})))
    full = np.array([each.gsd for each in found["full"]])
    columns = [
        "effort",
        "cover of the 95 % interval",
        "tiles, median",
        "ended early",
        "difference to `full`: median",
    ]
    columns += ["95th percentile"]
    with recording("speed", ["stopping"], chosen.record):
        print(header(*columns))
        for effort, outcomes in found.items():
            off = np.abs(np.log(np.array([each.gsd for each in outcomes]) / full))
            print(
                f"| {effort} | {np.mean([each.covered for each in outcomes]):.1%} | "
                f"{np.median([each.share for each in outcomes]):.1%} | "
                f"{np.mean([each.converged for each in outcomes]):.0%} | {np.nanmedian(off):.2%} | "
                f"{np.nanpercentile(off, 95):.1%} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
