"""Measure large images.

``python -m research.benchmarks.gigapixel make|search``. Prints Markdown; ``--record`` keeps it.

A mosaic is laid out of images of known scale, towns with fields between them, every pixel of a town
at exactly 0.2 m. ``search`` runs one mosaic with one effort in this process and tells tiles,
seconds, memory and the scale.
"""

from __future__ import annotations

import argparse
import csv
import resource
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
import rasterio

from research.results.record import add_record_option, header, recording
from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.detection.detector import load_detector
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """Picture ``[h, w, 3]``."""

GSD_M = 0.2
CELL_PX = 512
# Standard deviation, in cells, of the noise from which towns grow.
_TOWN_CELLS = 4.0
SETS = {"cannes": "table.csv", "saopaulo": "table.csv", "estonia": "upright.csv"}


def pictures(data: Path, name: str, table: str) -> list[Picture]:
    """Load images of the val split, BGR, at 0.2 m/px; empty ones stay as they are."""
    images = []
    with (data / "gsd" / table).open() as lines:
        for row in csv.DictReader(lines):
            if row["set"] == name and row["split"] == "val":
                image = np.asarray(cv2.imread(str(data / "gsd" / row["file"])), np.uint8)
                ratio = float(row["gsd_m_per_px"]) / GSD_M
                if ratio < 0.99:
                    image = _resized(image, ratio, cv2.INTER_AREA)
                elif ratio > 1.01:
                    image = _resized(image, ratio, cv2.INTER_CUBIC)
                images.append(image)
    return images


def _resized(image: Picture, ratio: float, how: int) -> Picture:
    return np.asarray(cv2.resize(image, None, fx=ratio, fy=ratio, interpolation=how), np.uint8)


def layout(cells: int, share: float, rng: Generator) -> NDArray[Any]:
    """Draw where towns are: ``[cells, cells]`` bool."""
    noise = cv2.GaussianBlur(
        rng.normal(size=(cells, cells)).astype(np.float32), (0, 0), _TOWN_CELLS
    )
    return np.asarray(noise > np.quantile(noise, 1 - share))


def _cell(pictures: list[Picture], rng: Generator) -> Picture:
    image = pictures[rng.integers(len(pictures))]
    down, right = (max(0, CELL_PX - side) for side in image.shape[:2])
    image = np.pad(image, [(0, down), (0, right), (0, 0)], "symmetric")
    top, left = (int(rng.integers(side - CELL_PX + 1)) for side in image.shape[:2])
    image = image[top : top + CELL_PX, left : left + CELL_PX]
    image = np.rot90(image, int(rng.integers(4)))
    return image[:, ::-1] if rng.integers(2) else image


def make(data: Path, out: Path, side: int, share: float, town: str, seed: int) -> None:
    """Write a mosaic as a tiled TIFF, row of cells by row of cells."""
    rng = np.random.default_rng(seed)
    towns = pictures(data, town, SETS[town])
    fields = pictures(data, "empty", "table.csv")
    where = layout(side // CELL_PX, share, rng)
    profile = {
        "driver": "GTiff",
        "width": side,
        "height": side,
        "count": 3,
        "dtype": "uint8",
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "compress": "jpeg",
        "photometric": "ycbcr",
        "jpeg_quality": 92,
        "bigtiff": "if_safer",
    }
    with rasterio.open(out, "w", **profile) as file:
        for row in range(side // CELL_PX):
            for column in range(side // CELL_PX):
                cell = _cell(towns if where[row, column] else fields, rng)
                window = (
                    (row * CELL_PX, (row + 1) * CELL_PX),
                    (column * CELL_PX, (column + 1) * CELL_PX),
                )
                bands = cell[:, :, ::-1].transpose(2, 0, 1)
                file.write(np.ascontiguousarray(bands), window=window)


def search(image: Path, effort: str, threads: int | None) -> str:
    """Format one line of a table for one image and effort."""
    detector = load_detector(resolve_model(), Runtime(threads=threads))
    options = ScaleOptions.of({"effort": effort})
    started = time.perf_counter()
    cpu = time.process_time()
    with open_raster(image, options.reading) as raster:
        estimate = analyse_raster(detector, raster, options).estimate
    seconds = time.perf_counter() - started
    cpu = time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    details = estimate.details
    return (
        f"| {effort} | {image.stem} | {details.tiles_searched} | {details.tiles_total} | "
        f"{details.stopped_because} | "
        f"{seconds:.0f} | {cpu:.0f} | {estimate.gsd_m_per_px or 0:.4f} | "
        f"{estimate.gsd_ci95_low_m_per_px or 0:.3f} to "
        f"{estimate.gsd_ci95_high_m_per_px or 0:.3f} | {estimate.status} | {estimate.n_vehicles} | "
        f"{peak:.0f} |"
    )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("out", type=Path)
    making.add_argument("--data", type=Path, required=True)
    making.add_argument("--side", type=int, default=8192)
    making.add_argument("--towns", type=float, default=0.2, help="share of the area")
    making.add_argument("--set", dest="town", choices=sorted(SETS), default="cannes")
    making.add_argument("--seed", type=int, default=0)
    searching = commands.add_parser("search")
    searching.add_argument("images", type=Path, nargs="+")
    searching.add_argument(
        "--effort", choices=["full", "auto", "fast"], nargs="+", default=["auto"]
    )
    searching.add_argument("--threads", type=int)
    add_record_option(searching)
    arguments = parser.parse_args()
    if arguments.command == "make":
        make(
            arguments.data,
            arguments.out,
            arguments.side,
            arguments.towns,
            arguments.town,
            arguments.seed,
        )
        return
    with recording("speed", ["large"], arguments.record):
        columns = (
            "effort",
            "image",
            "tiles",
            "of",
            "ended",
            "wall s",
            "CPU s",
            "GSD",
            "interval",
            "status",
        )
        print(header(*columns, "vehicles", "peak MiB"))
        for image in arguments.images:
            for effort in arguments.effort:
                print(search(image, effort, arguments.threads), flush=True)


if __name__ == "__main__":
    main()
