"""Measure flights of known scale, made from real pixels.

``python -m research.benchmarks.flights {pooled,matched} DATA``.

``pooled`` turns, dims, blurs and JPEG-codes tiles of one scale into flights of 24 photographs and
compares the scale by all of them with the truth, with the region unknown and given. ``matched``
cuts overlapping photographs of mixed scales out of mosaics; two thirds of them lose their vehicles.
"""

from __future__ import annotations

import argparse
import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from research.results.record import add_record_option, recording
from vehanchor.engine import Engine
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor_flight.components import single_component
from vehanchor_flight.estimate import conclude, search_flight
from vehanchor_flight.inputs import InputPhotograph
from vehanchor_flight.photograph import (
    Photograph,
    StoredPhotograph,
    per_photograph_witnesses,
    reference_member,
)
from vehanchor_flight.record import Failure, conclude_flight
from vehanchor_flight.records import FlightEstimate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

_REGIONS = {
    "cannes": "europe",
    "estonia": "northern_europe",
    "ucm": "north_america",
    "saopaulo": "south_america",
}
_FLIGHTS = 4
_PHOTOGRAPHS = 24


def tiles(data: Path, name: str, split: str) -> list[tuple[Path, float]]:
    """List the images of a set and their scale."""
    rows = []
    for table in ("table.csv", "upright.csv"):
        with (data / "gsd" / table).open() as file:
            rows += [
                row for row in csv.DictReader(file) if row["set"] == name and row["split"] == split
            ]
    folder = (data / "gsd").resolve()
    return [(folder / row["file"], float(row["gsd_m_per_px"])) for row in rows]


def read(path: Path) -> Picture:
    """Read an image, ``[h, w, 3]`` BGR."""
    return np.asarray(cv2.imread(str(path)), dtype=np.uint8)


def spoiled(image: Picture, rng: Generator) -> Picture:
    """Change exposure, add noise and JPEG artefacts."""
    gain = rng.uniform(0.75, 1.25)
    pixels = image.astype(np.float64) * gain + rng.uniform(-12, 12)
    pixels += rng.normal(0, rng.uniform(0, 4), image.shape)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))]
    levels = np.clip(pixels, 0, 255).astype(np.uint8)
    _, coded = cv2.imencode(".jpg", levels, quality)
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)


def turned(image: Picture, rng: Generator) -> Picture:
    """Cut the largest square inside the image at any angle; turn a small one by right angles."""
    side = min(image.shape[:2])
    if side < 400:
        return np.ascontiguousarray(np.rot90(image, int(rng.integers(4))))
    inner = int(side / math.sqrt(2))
    move = cv2.getRotationMatrix2D((side / 2, side / 2), rng.uniform(0, 360), 1.0)
    move[:, 2] += (inner - side) / 2
    return np.asarray(
        cv2.warpAffine(image, move, (inner, inner), flags=cv2.INTER_CUBIC), dtype=np.uint8
    )


def searched_photographs(
    taken: Sequence[InputPhotograph], detector: Detector, *, featured: bool = False
) -> list[Photograph]:
    """Search photographs; the first that cannot be used ends the benchmark."""
    photographs = []
    for result in search_flight(taken, detector, ScaleOptions(), featured=featured):
        if isinstance(result, Failure):
            raise result.error
        photographs.append(result)
    return photographs


def pooled_flight(photographs: Sequence[Photograph], detector: Detector) -> FlightEstimate:
    """Make the record of photographs of one scale."""
    component = single_component(range(len(photographs)), reference_member(photographs))
    return conclude_flight(photographs, [component], detector.card, same_scale=True)


def pooled(data: Path, split: str, flights: int) -> None:
    """Print a table of pooled flights by set and region."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    print(
        "| set | region | error of each flight of 24 | median | inside the interval | high over "
        "low |"
    )
    print("|---|---|---|---|---|---|")
    all_errors: dict[str, list[float]] = {"unknown": [], "given": []}
    for name in _REGIONS:
        files = tiles(data, name, split)
        estimates = _pooled_estimates(files, name, flights=flights, detector=detector)
        truth = files[0][1]
        for region, of_region in estimates.items():
            if not of_region:
                continue
            errors = _relative_errors(of_region, truth)
            all_errors[region] += [abs(error) for error in errors]
            print(_pooled_row(f"{name} | {region}", of_region, truth), flush=True)
    for region, errors in all_errors.items():
        print(f"| all | {region} | | {100 * np.median(errors):.1f} % | | |")


def _pooled_estimates(
    files: list[tuple[Path, float]], name: str, *, flights: int, detector: Detector
) -> dict[str, list[FlightEstimate]]:
    """Estimate flights of tiles of a set, with the region unknown and, if possible, given."""
    estimates: dict[str, list[FlightEstimate]] = {"unknown": [], "given": []}
    region = _REGIONS[name]
    for seed in range(flights):
        rng = np.random.default_rng([seed, 20261121])
        indices = rng.choice(len(files), min(_PHOTOGRAPHS, len(files)), replace=False)
        inputs = []
        for k in indices:
            path, _ = files[k]
            picture = spoiled(turned(read(path), rng), rng)
            inputs.append(InputPhotograph(str(k), picture[:, :, ::-1]))
        photographs = searched_photographs(inputs, detector)
        estimates["unknown"].append(pooled_flight(photographs, detector))
        if region in detector.card.region_lengths_m:
            options = ScaleOptions.of({"region": region})
            regional = [_with_options(photograph, detector, options) for photograph in photographs]
            estimates["given"].append(pooled_flight(regional, detector))
    return estimates


def _with_options(photograph: Photograph, detector: Detector, options: ScaleOptions) -> Photograph:
    stored = StoredPhotograph.of(photograph.view, photograph.analysis)
    return Photograph.of(photograph.name, stored, detector.card, options)


def _relative_errors(estimates: Sequence[FlightEstimate], truth: float) -> list[float]:
    """Compute signed relative errors; NaN without a scale."""
    return [
        estimate.gsd_m_per_px / truth - 1 if estimate.gsd_m_per_px else math.nan
        for estimate in estimates
    ]


def _pooled_row(name: str, estimates: Sequence[FlightEstimate], truth: float) -> str:
    errors = _relative_errors(estimates, truth)
    # A missing interval does not hold the truth, and counts as wide.
    lows = [estimate.gsd_ci95_low_m_per_px for estimate in estimates]
    highs = [estimate.gsd_ci95_high_m_per_px for estimate in estimates]
    intervals = list(zip(lows, highs, strict=True))
    inside = sum((low or 9) <= truth <= (high or 0) for low, high in intervals)
    ratio = np.median([(high or 9) / (low or 1) for low, high in intervals])
    percents = ", ".join(f"{100 * error:+.1f}" for error in errors)
    median = f"{100 * np.median(np.abs(errors)):.1f} %"
    return f"| {name} | {percents} | {median} | {inside} of {len(estimates)} | {ratio:.2f} |"


def worlds(data: Path) -> dict[str, Picture]:
    """Load mosaics of neighbouring val tiles, and single large ones, all of 0.20 m/px."""
    folder = data / "vehicles" / "images"
    strips = {"cannes 846 to 850": range(846, 851), "cannes 911 to 914": range(911, 915)}
    mosaics = {
        name: np.hstack([read(folder / f"cannes_{n}.jpg") for n in numbers])
        for name, numbers in strips.items()
        if all((folder / f"cannes_{n}.jpg").exists() for n in numbers)
    }
    for name in ("0_04_05", "2_01_05", "2_05_05"):
        mosaics[f"estonia {name}"] = read(data / "upright" / "images" / f"estonia_{name}.jpg")
    return mosaics


def cut_flight(world: Picture, rng: Generator, n: int) -> tuple[list[Picture], NDArray[np.float64]]:
    """Make photographs of 480 x 360 px at random positions, turns and scales of 0.6 to 1.7.

    Returns the photographs and their scales.
    """
    width = 480
    height = 360
    photographs: list[Picture] = []
    scales: list[float] = []
    while len(photographs) < n:
        scale = float(np.exp(rng.uniform(np.log(0.6), np.log(1.7))))
        turn = rng.uniform(0, 2 * np.pi)
        cos = np.cos(turn)
        sin = np.sin(turn)
        reach_x = scale * (abs(width * cos) + abs(height * sin)) / 2
        reach_y = scale * (abs(width * sin) + abs(height * cos)) / 2
        if 2 * reach_x >= world.shape[1] or 2 * reach_y >= world.shape[0]:
            continue
        x = rng.uniform(reach_x, world.shape[1] - reach_x)
        y = rng.uniform(reach_y, world.shape[0] - reach_y)
        move = cv2.getRotationMatrix2D((x, y), float(np.degrees(turn)), 1 / scale)
        move[:, 2] += np.array([width / 2 - x, height / 2 - y])
        # A reduced photograph is blurred first, so that it does not alias.
        sharp = cv2.GaussianBlur(world, (0, 0), 0.4 * scale) if scale > 1 else world
        cut = cv2.warpAffine(sharp, move, (width, height), flags=cv2.INTER_LINEAR)
        photograph = spoiled(np.asarray(cut, dtype=np.uint8), rng)
        photographs.append(photograph[:, :, ::-1])
        scales.append(scale)
    return photographs, np.array(scales)


def matched(data: Path, flights: int) -> None:
    """Print a table of matched flights, this many over each mosaic."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    print("| world | in components | median | 95th percentile | inside the interval | dropped |")
    print("|---|---|---|---|---|---|")
    all_errors: list[float] = []
    n_inside = 0
    for number, (name, world) in enumerate(worlds(data).items()):
        for seed in range(flights):
            seeds = [number, seed, 20261121] if seed else [number, 20261121]
            rng = np.random.default_rng(seeds)
            errors, inside, links = _matched_flight(world, detector, rng)
            all_errors += errors
            n_inside += inside
            print(
                f"| {name} | {links.sizes} | {_quantiles(errors)} | "
                f"{inside} of {len(errors)} | {links.dropped} of {links.total} |",
                flush=True,
            )
    print(f"| all | | {_quantiles(all_errors)} | {n_inside} of {len(all_errors)} | |")


class _Links(NamedTuple):
    """Sizes of a flight's components, its dropped links, and all of its links."""

    sizes: str
    dropped: int
    total: int


def _matched_flight(
    world: Picture, detector: Detector, rng: Generator
) -> tuple[list[float], int, _Links]:
    """Estimate a flight over a mosaic; two thirds of its photographs lose their vehicles.

    Returns:
        Errors of the photographs with a scale, how many intervals hold the truth, and the links.
    """
    images, factors = cut_flight(world, rng, _PHOTOGRAPHS)
    inputs = [InputPhotograph(str(k), image) for k, image in enumerate(images)]
    photographs = searched_photographs(inputs, detector, featured=True)
    photographs = [
        photograph if k % 3 == 0 else without_vehicles(photograph)
        for k, photograph in enumerate(photographs)
    ]
    record = conclude(photographs, detector.card, same_scale=False)
    errors = []
    n_inside = 0
    for scale in record.photographs:
        gsd = scale.gsd_m_per_px
        low = scale.gsd_ci95_low_m_per_px
        high = scale.gsd_ci95_high_m_per_px
        if gsd is None or low is None or high is None:
            continue
        truth = 0.2 * factors[int(scale.photograph)]
        errors.append(abs(gsd / truth - 1))
        n_inside += low <= truth <= high
    links = _Links(
        sizes=", ".join(str(component.n_photographs) for component in record.components),
        dropped=sum(link.dropped is not None for link in record.links),
        total=len(record.links),
    )
    return errors, n_inside, links


def _quantiles(errors: Sequence[float]) -> str:
    """Format the median and the 95th percentile as two cells."""
    return f"{100 * np.median(errors):.1f} % | {100 * np.percentile(errors, 95):.1f} %"


def without_vehicles(photograph: Photograph) -> Photograph:
    """Remove the vehicles of a photograph."""
    detections = photograph.view.detections
    reductions = detections.reductions
    if reductions is not None:
        reductions = reductions[:0]
    appearance = detections.appearance
    if appearance is not None:
        appearance = appearance.take(np.zeros(len(appearance), bool))
    none = replace(
        detections,
        boxes=detections.boxes[:0],
        scores=detections.scores[:0],
        reductions=reductions,
        appearance=appearance,
    )
    stored = StoredPhotograph(
        photograph.view.image,
        none,
        detail_share=1.0,
        others=per_photograph_witnesses(photograph.analysis.witnesses),
    )
    return Photograph.of(
        photograph.name, stored, photograph.view.card, photograph.view.options, photograph.features
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("pooled", "matched"))
    parser.add_argument("data", type=Path, nargs="?", default=Path("../shared/data"))
    parser.add_argument("--split", default="val")
    parser.add_argument(
        "--flights", type=int, help="per set (pooled, default 4) or per mosaic (matched, default 1)"
    )
    arguments = add_record_option(parser).parse_args()
    with recording("flights", [arguments.what], arguments.record):
        if arguments.what == "pooled":
            pooled(arguments.data, arguments.split, arguments.flights or _FLIGHTS)
        else:
            matched(arguments.data, arguments.flights or 1)


if __name__ == "__main__":
    main()
