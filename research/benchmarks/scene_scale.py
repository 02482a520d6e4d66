"""Measure the scene-scale prior alone on places outside the training data.

``python -m research.benchmarks.scene_scale``.

The photographs are of the sets kept for evaluation. Their scale is a car's usual length in that
country over the median length of the cars that people drew, right within a tenth or so; the
question is whether the prior is right within a factor of 1.5. ``--network FILE`` takes another
network than the bundled one. Prints Markdown; ``--record`` keeps it.
"""

from __future__ import annotations

import argparse
import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.results.record import add_record_option, recording
from vehanchor.detection.boxes import boxes_from_corners
from vehanchor.detection.scene_scale import SceneScaleNetwork, load_scene_scale
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.scale.density import credible_interval
from vehanchor_evaluation.dota import read_labels

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
# The set ucas is left out: it has too few labels, and some are displaced.
_CAR_M = {"jekhor": 4.3, "drashti": 3.9, "dota": 4.6, "crossings": 4.8}
# Cars that a photograph of an oriented set needs.
_MIN_CARS = 2
# From this ratio of an upright box's sides on, its car is parallel to the box.
_LEVEL_RATIO = 1.9
_BORDER_PX = 3
_NEAR = np.log(1.5)


class Prior(NamedTuple):
    """Prior of one photograph, and the truth.

    Attributes:
        gsd_m_per_px: scale by its cars.
        log_error: absolute log error of the density's median.
        held: whether the 95 % interval holds the scale.
        spread: the interval's upper end over its lower one.
    """

    gsd_m_per_px: float
    log_error: float
    held: bool
    spread: float


def oriented_images(folder: Path) -> Iterator[tuple[str, Path, float]]:
    """List set, photograph and median length of its cars in pixels, with turned boxes."""
    with (folder / "index.csv").open(newline="") as handle:
        rows = [
            row for row in csv.DictReader(handle) if row["split"] == "val" and row["set"] in _CAR_M
        ]
    for row in rows:
        cars = read_labels(folder / "labels" / f"{Path(row['file']).stem}.txt").of_class(
            "small-vehicle"
        )
        if len(cars) >= _MIN_CARS:
            lengths_px = boxes_from_corners(cars)[:, 2]
            yield row["set"], folder / row["file"], float(np.median(lengths_px))


def upright_images(folder: Path) -> Iterator[tuple[str, Path, float]]:
    """List the same with upright boxes, by whole cars that are parallel to their box."""
    with (folder / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["set"] in _CAR_M]
    for row in rows:
        path = folder / row["file"]
        with open_raster(path) as raster:
            ends = np.array([raster.width_px, raster.height_px])
        lengths = level_lengths(
            read_labels(folder / "labels" / f"{path.stem}.txt").of_class("small-vehicle"), ends
        )
        if len(lengths):
            yield row["set"], path, float(np.median(lengths))


def level_lengths(corners: NDArray[np.float64], ends: NDArray[np.int_]) -> NDArray[np.float64]:
    """Measure the longer sides of upright boxes ``[n, 4, 2]`` that are clearly longer one way."""
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    sides = np.sort(high - low, axis=1)
    is_low_inside = (low > _BORDER_PX).all(axis=1)
    is_high_inside = (high < ends - _BORDER_PX).all(axis=1)
    whole = is_low_inside & is_high_inside
    is_level = sides[:, 1] > _LEVEL_RATIO * sides[:, 0]
    return np.asarray(sides[whole & is_level, 1])


def row(name: str, priors: list[Prior]) -> str:
    """Format a line of the table."""
    errors = np.array([prior.log_error for prior in priors])
    scales = [prior.gsd_m_per_px for prior in priors]
    return (
        f"| {name} | {len(priors)} | {min(scales):.3f} to {max(scales):.3f} | "
        f"{np.median(errors):.2f} "
        f"| {np.mean(errors < _NEAR):.0%} | {np.mean([prior.held for prior in priors]):.0%} "
        f"| {np.median([prior.spread for prior in priors]):.1f} |"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", type=Path)
    options = add_record_option(parser).parse_args()
    network = SceneScaleNetwork(options.network) if options.network else load_scene_scale()
    by_set: dict[str, list[Prior]] = {}
    for images in (oriented_images(DATA / "vehicles"), upright_images(DATA / "upright")):
        for name, path, length_px in images:
            gsd = _CAR_M[name] / length_px
            with open_raster(path) as raster:
                density = network.predict(raster).density
            median = credible_interval(density, probability=0.0).low
            low, high = credible_interval(density)
            prior = Prior(
                gsd,
                log_error=abs(float(np.log(median / gsd))),
                held=low < gsd < high,
                spread=high / low,
            )
            by_set.setdefault(name, []).append(prior)
    by_set["all"] = [prior for priors in by_set.values() for prior in priors]
    with recording("scale", ["unseen_ground"], options.record):
        print(
            "| set | images | m/px by cars | median log error | within 1.5 | 95 % interval "
            "holds | its high to low |"
        )
        print("|---|---|---|---|---|---|---|")
        print("\n".join(row(name, priors) for name, priors in by_set.items()))


if __name__ == "__main__":
    main()
