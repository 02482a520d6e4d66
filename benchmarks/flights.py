"""Flights of known scale, made from real pixels: ``python benchmarks/flights.py {pooled,matched,real,cost} DATA``.

``pooled`` turns, dims, blurs and JPEG-codes tiles of one scale into flights of 24 photographs and compares the scale by
all of them with the truth, with the region unknown and given.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.estimate import open_detector
from vehanchor.flight.concluding import Failure, chief_member, conclude_flight
from vehanchor.flight.estimate import Taken, look_at_flight
from vehanchor.flight.islands import single_island
from vehanchor.flight.photograph import Look, Photograph
from vehanchor.options import ScaleOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.records import FlightEstimate

_REGIONS = {"cannes": "europe", "estonia": "europe", "ucm": "north_america", "saopaulo": "south_america"}
_FLIGHTS, _PHOTOGRAPHS = 4, 24


def tiles(data: Path, name: str, split: str) -> list[tuple[Path, float]]:
    """The images of a set and their scale."""
    rows = []
    for table in ("table.csv", "upright.csv"):
        with (data / "gsd" / table).open() as file:
            rows += [row for row in csv.DictReader(file) if row["set"] == name and row["split"] == split]
    return [((data / "gsd" / row["file"]).resolve(), float(row["gsd_m_per_px"])) for row in rows]


def spoiled(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Another exposure, noise and JPEG."""
    seen = image.astype(np.float64) * rng.uniform(0.75, 1.25) + rng.uniform(-12, 12)
    seen += rng.normal(0, rng.uniform(0, 4), image.shape)
    quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(70, 96))]
    _, coded = cv2.imencode(".jpg", np.clip(seen, 0, 255).astype(np.uint8), quality)
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)


def turned(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The largest square inside the image turned by any angle; a quarter turn of a small one."""
    side = min(image.shape[:2])
    if side < 400:
        return np.ascontiguousarray(np.rot90(image, rng.integers(4)))
    inner = int(side / math.sqrt(2))
    move = cv2.getRotationMatrix2D((side / 2, side / 2), float(rng.uniform(0, 360)), 1.0)
    move[:, 2] += (inner - side) / 2
    return np.asarray(cv2.warpAffine(image, move, (inner, inner), flags=cv2.INTER_CUBIC), dtype=np.uint8)


def pooled_flight(looks: Sequence[Photograph | Failure], detector: Detector) -> FlightEstimate:
    """The record of photographs of one scale."""
    members = [each for each in looks if isinstance(each, Photograph)]
    places = [place for place, each in enumerate(looks) if isinstance(each, Photograph)]
    return conclude_flight(looks, [single_island(places, chief_member(members))], detector.card, same_scale=True)


def pooled(data: Path, split: str, flights: int) -> None:
    """Print a table."""
    detector = open_detector(None, ScaleOptions(), threads=1)
    print("| set | region | error of each flight of 24 | median | inside the interval | high over low |")
    print("|---|---|---|---|---|---|")
    every: dict[str, list[float]] = {"unknown": [], "given": []}
    for name in _REGIONS:
        rows: dict[str, list[FlightEstimate]] = {"unknown": [], "given": []}
        files = tiles(data, name, split)
        for seed in range(flights):
            rng = np.random.default_rng([seed, 20261121])
            chosen = rng.choice(len(files), min(_PHOTOGRAPHS, len(files)), replace=False)
            taken = [Taken(str(k), spoiled(turned(cv2.imread(str(files[k][0])), rng), rng)[:, :, ::-1]) for k in chosen]
            looks = look_at_flight(taken, detector, ScaleOptions())
            rows["unknown"].append(pooled_flight(looks, detector))
            if _REGIONS[name] in detector.card.region_lengths_m:
                given = ScaleOptions.of({"region": _REGIONS[name]})
                again = [
                    Photograph.of(
                        each.name,
                        Look(each.view.image, each.view.sighting, each.analysis.resolved),
                        detector.card,
                        given,
                    )
                    for each in looks
                    if isinstance(each, Photograph)
                ]
                rows["given"].append(pooled_flight(again, detector))
        for region, found in rows.items():
            truth = files[0][1]
            errors = [each.gsd_m_per_px / truth - 1 if each.gsd_m_per_px else math.nan for each in found]
            if not errors:
                continue
            every[region] += [abs(error) for error in errors]
            inside = sum(
                (each.gsd_ci95_low_m_per_px or 9) <= truth <= (each.gsd_ci95_high_m_per_px or 0) for each in found
            )
            wide = np.median([(e.gsd_ci95_high_m_per_px or 9) / (e.gsd_ci95_low_m_per_px or 1) for e in found])
            words = ", ".join(f"{100 * error:+.1f}" for error in errors)
            median = f"{100 * np.median(np.abs(errors)):.1f} %"
            print(f"| {name} | {region} | {words} | {median} | {inside} of {len(found)} | {wide:.2f} |", flush=True)
    for region, values in every.items():
        print(f"| all | {region} | | {100 * np.median(values):.1f} % | | |")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("pooled",))
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="val")
    parser.add_argument("--flights", type=int, default=_FLIGHTS)
    arguments = parser.parse_args()
    pooled(arguments.data, arguments.split, arguments.flights)


if __name__ == "__main__":
    main()
