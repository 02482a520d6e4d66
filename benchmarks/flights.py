"""Flights of known scale, made from real pixels: ``python benchmarks/flights.py {pooled,matched,tilt} DATA``.

``pooled`` turns, dims, blurs and JPEG-codes tiles of one scale into flights of 24 photographs and compares the scale by
all of them with the truth, with the region unknown and given. ``matched`` cuts overlapping photographs of mixed scales
out of mosaics; two thirds of them lose their vehicles. ``tilt`` sees val tiles of at least 40 labelled cars from aside
(pitch -80 to -50, three focal lengths) and from straight above, and has the cars tell where the camera looked.
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

from vehanchor.anchors.camera import equivalent_lens
from vehanchor.anchors.leaning import SURE, lean
from vehanchor.detection.search import search
from vehanchor.estimate import open_detector
from vehanchor.flight.concluding import Failure, chief_member, conclude_flight
from vehanchor.flight.estimate import conclude, look_at_flight
from vehanchor.flight.islands import single_island
from vehanchor.flight.photograph import Look, Photograph
from vehanchor.flight.taken import Taken
from vehanchor.imagery.raster import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.scale.plane import GroundPlane

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.records import FlightEstimate

_REGIONS = {"cannes": "europe", "estonia": "europe", "ucm": "north_america", "saopaulo": "south_america"}
_FLIGHTS, _PHOTOGRAPHS = 4, 24
_TILTS_DEG = (0.0, 10.0, 20.0, 30.0, 40.0)
_LEAST_LABELLED = 40


def tiles(data: Path, name: str, split: str) -> list[tuple[Path, float]]:
    """The images of a set and their scale."""
    rows = []
    for table in ("table.csv", "upright.csv"):
        with (data / "gsd" / table).open() as file:
            rows += [row for row in csv.DictReader(file) if row["set"] == name and row["split"] == split]
    return [((data / "gsd" / row["file"]).resolve(), float(row["gsd_m_per_px"])) for row in rows]


def read(path: Path) -> NDArray[np.uint8]:
    """An image, ``[h, w, 3]`` BGR."""
    return np.asarray(cv2.imread(str(path)), dtype=np.uint8)


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
        return np.ascontiguousarray(np.rot90(image, int(rng.integers(4))))
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
            taken = [Taken(str(k), spoiled(turned(read(files[k][0]), rng), rng)[:, :, ::-1]) for k in chosen]
            looks = look_at_flight(taken, detector, ScaleOptions())
            rows["unknown"].append(pooled_flight(looks, detector))
            if _REGIONS[name] in detector.card.region_lengths_m:
                given = ScaleOptions.of({"region": _REGIONS[name]})
                again = [
                    Photograph.of(
                        each.name,
                        Look.of(each.view.image, each.view.sighting, each.analysis),
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
    width, height = 480, 360
    photographs: list[NDArray[np.uint8]] = []
    scales: list[float] = []
    while len(photographs) < n:
        scale = float(np.exp(rng.uniform(np.log(0.6), np.log(1.7))))
        turn = float(rng.uniform(0, 2 * np.pi))
        reach_x = scale * (abs(width * np.cos(turn)) + abs(height * np.sin(turn))) / 2
        reach_y = scale * (abs(width * np.sin(turn)) + abs(height * np.cos(turn))) / 2
        if 2 * reach_x >= world.shape[1] or 2 * reach_y >= world.shape[0]:
            continue
        x, y = rng.uniform(reach_x, world.shape[1] - reach_x), rng.uniform(reach_y, world.shape[0] - reach_y)
        move = cv2.getRotationMatrix2D((x, y), float(np.degrees(turn)), 1 / scale)
        move[:, 2] += np.array([width / 2 - x, height / 2 - y])
        seen = cv2.GaussianBlur(world, (0, 0), 0.4 * scale) if scale > 1 else world
        cut = cv2.warpAffine(seen, move, (width, height), flags=cv2.INTER_LINEAR)
        photographs.append(spoiled(np.asarray(cut, dtype=np.uint8), rng)[:, :, ::-1])
        scales.append(scale)
    return photographs, np.array(scales)


def matched(data: Path) -> None:
    """Print a table."""
    detector = open_detector(None, ScaleOptions(), threads=1)
    print("| world | in islands | median | 95th percentile | ratios alone, median | inside the interval | dropped |")
    print("|---|---|---|---|---|---|---|")
    every: list[float] = []
    inside = total = 0
    for number, (name, world) in enumerate(worlds(data).items()):
        rng = np.random.default_rng([number, 20261121])
        images, factors = cut_flight(world, rng, _PHOTOGRAPHS)
        taken = [Taken(str(place), image) for place, image in enumerate(images)]
        looks = look_at_flight(taken, detector, ScaleOptions(), featured=True)
        looks = [each if place % 3 == 0 else without_vehicles(each) for place, each in enumerate(looks)]
        record = conclude(looks, detector.card, same_scale=False)
        errors, relative, held = [], [], 0
        main = [each for each in record.photographs if each.island == 0]
        offset = np.median(
            [math.log((each.gsd_m_per_px or math.nan) / (0.2 * factors[int(each.photograph)])) for each in main]
        )
        for each in record.photographs:
            if each.gsd_m_per_px is None or each.gsd_ci95_low_m_per_px is None or each.gsd_ci95_high_m_per_px is None:
                continue
            truth = 0.2 * factors[int(each.photograph)]
            errors.append(abs(each.gsd_m_per_px / truth - 1))
            held += each.gsd_ci95_low_m_per_px <= truth <= each.gsd_ci95_high_m_per_px
            if each.island == 0:
                relative.append(abs(math.log(each.gsd_m_per_px / truth) - offset))
        every += errors
        inside, total = inside + held, total + len(errors)
        sizes = ", ".join(str(island.n_photographs) for island in record.islands)
        dropped = sum(link.dropped is not None for link in record.links)
        print(
            f"| {name} | {sizes} | {100 * np.median(errors):.1f} % | {100 * np.percentile(errors, 95):.1f} % | "
            f"{100 * np.median(relative):.1f} % | {held} of {len(errors)} | {dropped} of {len(record.links)} |",
            flush=True,
        )
    print(
        f"| all | | {100 * np.median(every):.1f} % | {100 * np.percentile(every, 95):.1f} % | | {inside} of {total} | |"
    )


def without_vehicles(look: Photograph | Failure) -> Photograph | Failure:
    """The photograph as if no vehicle had been there."""
    if isinstance(look, Failure):
        return look
    seen = look.view.sighting
    bare = replace(
        seen,
        boxes=seen.boxes[:0],
        scores=seen.scores[:0],
        scales=None if seen.scales is None else seen.scales[:0],
        fleet=None if seen.fleet is None else seen.fleet.take(np.zeros(len(seen.fleet.log_odds), bool)),
        classes=None if seen.classes is None else seen.classes[:0],
    )
    again = Look(look.view.image, bare, 1.0, look.analysis.others)
    return Photograph.of(look.name, again, look.view.card, look.view.options, look.features)


def seen_aside(
    tile: NDArray[np.uint8], tilt_deg: float, roll_deg: float, focal_px: float, size: tuple[int, int]
) -> NDArray[np.uint8]:
    """The ground of a tile as a camera sees it that looks aside; its scale at the centre is the tile's."""
    plane = GroundPlane(1.0, tilt_deg, focal_px, *size, roll_deg)
    corners = np.array([(0.0, 0.0), (size[0], 0.0), (size[0], size[1]), (0.0, size[1])])
    centre = np.array([[size[0] / 2, size[1] / 2]])
    down = plane.down
    across = np.array([1.0, 0.0, 0.0]) - down[0] * down
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(down, across)])
    ground = (plane.ground(corners) - plane.ground(centre)) @ axes.T + np.array(tile.shape[1::-1]) / 2
    move = cv2.getPerspectiveTransform(ground.astype(np.float32), corners.astype(np.float32))
    return np.asarray(cv2.warpPerspective(tile, move, size, flags=cv2.INTER_LINEAR), dtype=np.uint8)


def tilted(data: Path, split: str, number: int) -> None:
    """Print a table: tilt by the cars alone, with the focal length known and unknown."""
    detector = open_detector(None, ScaleOptions(), threads=1)
    rng = np.random.default_rng(18)
    rows: dict[float, list[tuple[float, float, float]]] = {}
    few = dict.fromkeys(_TILTS_DEG, 0)
    with (data / "gsd" / "upright.csv").open() as file:
        listed = [row for row in csv.DictReader(file) if row["split"] == split and row["set"] == "estonia"]
    chosen = [row for row in listed if int(row["labelled_small_vehicles"] or 0) >= _LEAST_LABELLED][:number]
    for row in chosen:
        tile = read((data / "gsd" / row["file"]).resolve())
        for tilt in _TILTS_DEG:
            focal_35mm, roll = float(rng.choice((20.0, 26.0, 35.0))), float(rng.uniform(-10, 10))
            size = (round(0.7 * tile.shape[1]), round(0.5 * tile.shape[0]))
            focal = equivalent_lens(*size, focal_35mm).pixels
            image = seen_aside(tile, tilt, roll, focal, size) if tilt else tile
            with open_raster(np.ascontiguousarray(spoiled(image, rng)[:, :, ::-1])) as raster:
                sighting = search(raster, detector, ScaleOptions().search)
            known = lean(sighting, image.shape[1], image.shape[0], focal)
            unknown = lean(sighting, image.shape[1], image.shape[0])
            if known is None or unknown is None:
                few[tilt] += 1
                continue
            rows.setdefault(tilt, []).append((known.tilt_deg, unknown.tilt_deg, unknown.chance_tilted))
    print("| pitch | images | fewer than 25 cars | error, focal length known | unknown | warned of |")
    print("|---|---|---|---|---|---|")
    for tilt, found in sorted(rows.items()):
        known_off, unknown_off = (np.median([abs(each[k] - tilt) for each in found]) for k in (0, 1))
        warned = sum(each[2] >= SURE for each in found)
        print(
            f"| {tilt - 90:.0f} | {len(found)} | {few[tilt]} | {known_off:.1f} | {unknown_off:.1f} | "
            f"{warned} of {len(found)} |"
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("pooled", "matched", "tilt"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="val")
    parser.add_argument("--flights", type=int, default=_FLIGHTS)
    parser.add_argument("--images", type=int, default=8, help="tiles that are seen from aside")
    arguments = parser.parse_args()
    if arguments.what == "pooled":
        pooled(arguments.data, arguments.split, arguments.flights)
    elif arguments.what == "tilt":
        tilted(arguments.data, arguments.split, arguments.images)
    else:
        matched(arguments.data)


if __name__ == "__main__":
    main()
