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
from typing import TYPE_CHECKING

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

    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector

_REGIONS = {
    "cannes": "europe",
    "estonia": "northern_europe",
    "ucm": "north_america",
    "saopaulo": "south_america",
}
_FLIGHTS = 4
_PHOTOGRAPHS = 24


def tiles(data: Path, name: str, split: str) -> list[tuple[Path, float]]:
    """The images of a set and their scale."""
    rows = []
    for table in ("table.csv", "upright.csv"):
        with (data / "gsd" / table).open() as file:
            rows += [
                row for row in csv.DictReader(file) if row["set"] == name and row["split"] == split
            ]
    return [((data / "gsd" / row["file"]).resolve(), float(row["gsd_m_per_px"])) for row in rows]


def read(path: Path) -> NDArray[np.uint8]:
    """An image, ``[h, w, 3]`` BGR."""
    return np.asarray(cv2.imread(str(path)), dtype=np.uint8)


def spoiled(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Change exposure, add noise and JPEG artefacts."""
    seen = image.astype(np.float64) * rng.uniform(0.75, 1.25) + rng.uniform(-12, 12)
    seen += rng.normal(0, rng.uniform(0, 4), image.shape)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))]
    _, coded = cv2.imencode(".jpg", np.clip(seen, 0, 255).astype(np.uint8), quality)
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)


def turned(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The largest square inside the image turned by any angle; a quarter turn of a small one."""
    side = min(image.shape[:2])
    if side < 400:
        return np.ascontiguousarray(np.rot90(image, int(rng.integers(4))))
    inner = int(side / math.sqrt(2))
    move = cv2.getRotationMatrix2D((side / 2, side / 2), float(rng.uniform(0, 360)), 1.0)
    move[:, 2] += (inner - side) / 2
    return np.asarray(
        cv2.warpAffine(image, move, (inner, inner), flags=cv2.INTER_CUBIC), dtype=np.uint8
    )


def searched_photographs(
    taken: Sequence[InputPhotograph], detector: Detector, *, featured: bool = False
) -> list[Photograph]:
    """Search photographs; the first that cannot be used ends the benchmark."""
    found = search_flight(taken, detector, ScaleOptions(), featured=featured)
    for each in found:
        if isinstance(each, Failure):
            raise each.error
    return [each for each in found if isinstance(each, Photograph)]


def pooled_flight(photographs: Sequence[Photograph], detector: Detector) -> FlightEstimate:
    """The record of photographs of one scale."""
    component = single_component(range(len(photographs)), reference_member(photographs))
    return conclude_flight(photographs, [component], detector.card, same_scale=True)


def pooled(data: Path, split: str, flights: int) -> None:
    """Print a table."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    print(
        "| set | region | error of each flight of 24 | median | inside the interval | high over "
        "low |"
    )
    print("|---|---|---|---|---|---|")
    every: dict[str, list[float]] = {"unknown": [], "given": []}
    for name in _REGIONS:
        rows: dict[str, list[FlightEstimate]] = {"unknown": [], "given": []}
        files = tiles(data, name, split)
        for seed in range(flights):
            rng = np.random.default_rng([seed, 20261121])
            chosen = rng.choice(len(files), min(_PHOTOGRAPHS, len(files)), replace=False)
            taken = [
                InputPhotograph(str(k), spoiled(turned(read(files[k][0]), rng), rng)[:, :, ::-1])
                for k in chosen
            ]
            photographs = searched_photographs(taken, detector)
            rows["unknown"].append(pooled_flight(photographs, detector))
            if _REGIONS[name] in detector.card.region_lengths_m:
                given = ScaleOptions.of({"region": _REGIONS[name]})
                again = [
                    Photograph.of(
                        each.name,
                        StoredPhotograph.of(each.view, each.analysis),
                        detector.card,
                        given,
                    )
                    for each in photographs
                ]
                rows["given"].append(pooled_flight(again, detector))
        for region, found in rows.items():
            truth = files[0][1]
            errors = [
                each.gsd_m_per_px / truth - 1 if each.gsd_m_per_px else math.nan for each in found
            ]
            if not errors:
                continue
            every[region] += [abs(error) for error in errors]
            inside = sum(
                (each.gsd_ci95_low_m_per_px or 9) <= truth <= (each.gsd_ci95_high_m_per_px or 0)
                for each in found
            )
            wide = np.median(
                [(e.gsd_ci95_high_m_per_px or 9) / (e.gsd_ci95_low_m_per_px or 1) for e in found]
            )
            words = ", ".join(f"{100 * error:+.1f}" for error in errors)
            median = f"{100 * np.median(np.abs(errors)):.1f} %"
            print(
                f"| {name} | {region} | {words} | {median} | {inside} of {len(found)} | "
                f"{wide:.2f} |",
                flush=True,
            )
    for region, values in every.items():
        print(f"| all | {region} | | {100 * np.median(values):.1f} % | | |")


def worlds(data: Path) -> dict[str, NDArray[np.uint8]]:
    """Mosaics of neighbouring val tiles, and single large ones, all of 0.20 m/px."""
    folder = data / "vehicles" / "images"
    strips = {"cannes 846 to 850": range(846, 851), "cannes 911 to 914": range(911, 915)}
    found = {
        name: np.hstack([read(folder / f"cannes_{n}.jpg") for n in numbers])
        for name, numbers in strips.items()
        if all((folder / f"cannes_{n}.jpg").exists() for n in numbers)
    }
    for name in ("0_04_05", "2_01_05", "2_05_05"):
        found[f"estonia {name}"] = read(data / "upright" / "images" / f"estonia_{name}.jpg")
    return found


def cut_flight(
    world: NDArray[np.uint8], rng: np.random.Generator, n: int
) -> tuple[list[NDArray[np.uint8]], NDArray[np.float64]]:
    """Photographs of 480 x 360 px at random places, turns and scales of 0.6 to 1.7, and their scales."""
    width = 480
    height = 360
    photographs: list[NDArray[np.uint8]] = []
    scales: list[float] = []
    while len(photographs) < n:
        scale = float(np.exp(rng.uniform(np.log(0.6), np.log(1.7))))
        turn = float(rng.uniform(0, 2 * np.pi))
        reach_x = scale * (abs(width * np.cos(turn)) + abs(height * np.sin(turn))) / 2
        reach_y = scale * (abs(width * np.sin(turn)) + abs(height * np.cos(turn))) / 2
        if 2 * reach_x >= world.shape[1] or 2 * reach_y >= world.shape[0]:
            continue
        x = rng.uniform(reach_x, world.shape[1] - reach_x)
        y = rng.uniform(reach_y, world.shape[0] - reach_y)
        move = cv2.getRotationMatrix2D((x, y), float(np.degrees(turn)), 1 / scale)
        move[:, 2] += np.array([width / 2 - x, height / 2 - y])
        seen = cv2.GaussianBlur(world, (0, 0), 0.4 * scale) if scale > 1 else world
        cut = cv2.warpAffine(seen, move, (width, height), flags=cv2.INTER_LINEAR)
        photographs.append(spoiled(np.asarray(cut, dtype=np.uint8), rng)[:, :, ::-1])
        scales.append(scale)
    return photographs, np.array(scales)


def matched(data: Path, flights: int) -> None:
    """Print a table: so many flights over each world."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    print("| world | in components | median | 95th percentile | inside the interval | dropped |")
    print("|---|---|---|---|---|---|")
    every: list[float] = []
    inside = total = 0
    mosaics = list(worlds(data).items())
    for number, seed, (name, world) in (
        (k, seed, each) for k, each in enumerate(mosaics) for seed in range(flights)
    ):
        rng = np.random.default_rng([number, seed, 20261121] if seed else [number, 20261121])
        images, factors = cut_flight(world, rng, _PHOTOGRAPHS)
        taken = [InputPhotograph(str(place), image) for place, image in enumerate(images)]
        photographs = searched_photographs(taken, detector, featured=True)
        photographs = [
            each if place % 3 == 0 else without_vehicles(each)
            for place, each in enumerate(photographs)
        ]
        record = conclude(photographs, detector.card, same_scale=False)
        errors = []
        held = 0
        for each in record.photographs:
            if (
                each.gsd_m_per_px is None
                or each.gsd_ci95_low_m_per_px is None
                or each.gsd_ci95_high_m_per_px is None
            ):
                continue
            truth = 0.2 * factors[int(each.photograph)]
            errors.append(abs(each.gsd_m_per_px / truth - 1))
            held += each.gsd_ci95_low_m_per_px <= truth <= each.gsd_ci95_high_m_per_px
        every += errors
        inside = inside + held
        total = total + len(errors)
        sizes = ", ".join(str(component.n_photographs) for component in record.components)
        dropped = sum(link.dropped is not None for link in record.links)
        print(
            f"| {name} | {sizes} | {100 * np.median(errors):.1f} % | "
            f"{100 * np.percentile(errors, 95):.1f} % | "
            f"{held} of {len(errors)} | {dropped} of {len(record.links)} |",
            flush=True,
        )
    print(
        f"| all | | {100 * np.median(every):.1f} % | {100 * np.percentile(every, 95):.1f} % | "
        f"{inside} of {total} | |"
    )


def without_vehicles(photograph: Photograph) -> Photograph:
    """Remove the vehicles of a photograph."""
    seen = photograph.view.detections
    bare = replace(
        seen,
        boxes=seen.boxes[:0],
        scores=seen.scores[:0],
        reductions=None if seen.reductions is None else seen.reductions[:0],
        appearance=None
        if seen.appearance is None
        else seen.appearance.take(np.zeros(len(seen.appearance), bool)),
    )
    again = StoredPhotograph(
        photograph.view.image,
        bare,
        detail_share=1.0,
        others=per_photograph_witnesses(photograph.analysis.witnesses),
    )
    return Photograph.of(
        photograph.name, again, photograph.view.card, photograph.view.options, photograph.features
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("pooled", "matched"))
    parser.add_argument("data", type=Path, nargs="?", default=Path("../shared/data"))
    parser.add_argument("--split", default="val")
    parser.add_argument(
        "--flights", type=int, help="a set (pooled: 4), over each world (matched, 1)"
    )
    arguments = add_record_option(parser).parse_args()
    with recording("flights", [arguments.what], arguments.record):
        if arguments.what == "pooled":
            pooled(arguments.data, arguments.split, arguments.flights or _FLIGHTS)
        else:
            matched(arguments.data, arguments.flights or 1)


if __name__ == "__main__":
    main()
