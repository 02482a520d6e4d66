"""Measure what the metadata of a flight's photographs are worth.

``python -m research.benchmarks.flight_metadata {chia,baselines,oblique,outlines,rendered,cost} DATA [--cache FOLDER]``.

``chia`` links the 26 nadir photographs of DATA/chia, with whole metadata, without positions, without heights and
without both; then the seven photographs with the fewest vehicles. ``baselines`` compares the scales of single nadir
photographs with the distances between the positions of neighbours. ``oblique`` compares the scales of its 31 oblique
photographs with height, lens and pitch, with and without metadata. ``outlines`` compares areas on the ground in oblique
photographs with the areas in nadir photographs. ``rendered`` links rendered flights of ten photographs without cars,
with one false vehicle or without. ``cost`` measures flights of photographs of 12 Mpx.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import gc
import hashlib
import json
import math
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from research.results.record import add_record_option, recording
from vehanchor.detection.detections import Detections
from vehanchor.engine import Engine
from vehanchor.flight.estimate import conclude, open_journal, search_flight
from vehanchor.flight.features import Features, find_features
from vehanchor.flight.inputs import InputPhotograph
from vehanchor.flight.matching import match
from vehanchor.flight.photograph import Photograph, StoredPhotograph, photograph_codec
from vehanchor.flight.record import Failure
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera import Camera
from vehanchor_scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.records import FlightEstimate

_FEWEST = 7
_POSITION: dict[str, Any] = {"latitude_deg": None, "longitude_deg": None}
_HEIGHT: dict[str, Any] = {"height_m": None, "height_tag": "", "altitude_m": None}
_STRIPPED = {
    "whole": {},
    "without positions": _POSITION,
    "without heights": _HEIGHT,
    "without both": {**_POSITION, **_HEIGHT},
}
_NADIR_DEG = -85.0
_OUTLINES = Path(__file__).parent / "chia_outlines.json"
_RENDERED_GSD = (0.015, 0.02, 0.03)
_PHOTOGRAPHS, _SIZE, _STEP = 10, (2000, 1500), 600  # of a rendered flight; pixels, pixels from one to the next
_FOCAL_SHARE = 0.7  # focal length over the width: 24 mm (35 mm equivalent)
_POSITION_SD_M, _HEIGHT_SD = 1.0, 0.02  # of made-up metadata; the height's error is common to a flight
_STRIP = 10  # photographs over one rendered place, in the costs
_FALSE_RATIO = 3.4  # the scale by the false vehicle over the true scale, as in the flight of issue 32
_METRES_A_DEGREE = 111_195.0
_NEIGHBOURS, _BASELINE_M = 2, (10.0, 50.0)  # pairs of photographs whose positions are compared
_MEDIAN_ERROR, _QUARTILES_SD = 1.2533, 1.349  # of a normal distribution, in standard errors and deviations
_KEYS = {
    "cost": "photographs_12mpx",
    "baselines": "chia_baselines",
}  # of results; "cost" is what comes beyond the detection


class Truth(NamedTuple):
    """A row of DATA/chia/table.csv, with the scale at the centre by height, lens and pitch."""

    path: Path
    pitch_deg: float
    gsd_m_per_px: float


def chia_table(data: Path) -> Iterator[Truth]:
    """The photographs of DATA/chia."""
    with (data / "chia" / "table.csv").open() as file:
        for row in csv.DictReader(file):
            pitch, height, focal = (
                float(row[name]) for name in ("camera_pitch_deg", "height_above_takeoff_m", "focal_length_px")
            )
            coarser = math.cos(math.radians(90 + pitch)) ** -1.5
            yield Truth(data / "chia" / row["file"], pitch, height / focal * coarser)


def searched(
    name: str, image: ImageSource, detector: Detector, cache: Path, options: ScaleOptions | None = None
) -> Photograph:
    """A photograph with its features; the results are kept under its name and options."""
    chosen = options or ScaleOptions()
    key = hashlib.sha256(f"{detector.card.sha256} {Path(name).name} {options or ''}".encode()).hexdigest()[:24]
    known = cache / f"{key}.json"
    if not known.exists():
        (found,) = search_flight([InputPhotograph(name, image)], detector, chosen)
        if isinstance(found, Failure):
            raise found.error
        cache.mkdir(parents=True, exist_ok=True)
        known.write_text(json.dumps(photograph_codec().dump(StoredPhotograph.of(found.view, found.analysis))))
    stored = photograph_codec().load(json.loads(known.read_text()))
    kept = known.with_suffix(".npz")
    if not kept.exists():
        with open_raster(image) as raster:
            found_features = find_features(raster)
        np.savez(kept, points=found_features.points, descriptors=found_features.descriptors, pixel=found_features.pixel)
    with np.load(kept) as arrays:
        features = Features(arrays["points"], arrays["descriptors"], float(arrays["pixel"]))
    return Photograph.of(name, stored, detector.card, chosen, features)


def with_camera(
    photograph: Photograph, camera: CameraMetadata | None, detections: Detections | None = None
) -> Photograph:
    """A nadir photograph with other metadata or detections; what was measured in its pixels stays."""
    view, analysis = photograph.view, photograph.analysis
    others = tuple(each for each in analysis.others if each.kind != Camera.kind)
    stored = StoredPhotograph(
        view.image._replace(camera=camera), detections or view.detections, analysis.resolved, others, view.prior
    )
    return Photograph.of(photograph.name, stored, view.card, view.options, photograph.features)


def row(label: str, record: FlightEstimate, truth: dict[str, float]) -> str:
    """A row of a table: usable photographs, their errors, and the reasons of each component."""
    usable: list[float] = []
    others: list[float] = []
    for each in record.photographs:
        if each.gsd_m_per_px is not None:
            error = each.gsd_m_per_px / truth[each.photograph] - 1
            (usable if each.status == "ok" else others).append(error)
    reasons = ", ".join(f"{each.n_photographs} {each.pooled.reason or 'ok'}" for each in record.components)
    wrong = sum(abs(error) > 0.2 for error in usable)
    n = len(record.photographs)
    return f"| {label} | {len(usable)} of {n} | {_range(usable)} | {_range(others)} | {wrong} | {reasons} |"


def _range(errors: Sequence[float]) -> str:
    return f"{100 * min(errors):+.1f} to {100 * max(errors):+.1f}" if errors else "-"


def _print_heads(first: str) -> None:
    print(f"| {first} | ok | errors of the ok, % | errors of the others, % | ok and off by a fifth | components |")
    print("|---|---|---|---|---|---|")


def chia(data: Path, cache: Path) -> None:
    """Print a row for each set of photographs and metadata."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    rows = [each for each in chia_table(data) if each.pitch_deg < _NADIR_DEG]
    truth = {str(each.path): each.gsd_m_per_px for each in rows}
    photographs = [searched(name, name, detector, cache) for name in truth]
    order = np.argsort([each.analysis.estimate.n_vehicles for each in photographs], kind="stable")[:_FEWEST]
    _print_heads("photographs, metadata")
    for kind, members in (
        ("all", photographs),
        ("fewest vehicles", [photographs[place] for place in sorted(order)]),
    ):
        for name, fields in _STRIPPED.items():
            changed = [
                with_camera(each, camera and replace(camera, **fields))
                for each in members
                for camera in (each.view.image.camera,)
            ]
            record = conclude(changed, detector.card, same_scale=False)
            print(row(f"{kind}, {name}", record, truth), flush=True)


def baselines(data: Path, cache: Path) -> None:
    """Print, for each kind of scale, the ratio of the positions' distances to those by the scale of the second."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    rows = [each for each in chia_table(data) if each.pitch_deg < _NADIR_DEG]
    photographs = [searched(str(each.path), str(each.path), detector, cache) for each in rows]
    ratios: dict[str, list[float]] = {}
    for number, first in enumerate(photographs):
        for second in photographs[number + 1 : number + 1 + _NEIGHBOURS]:
            apart = _apart_m(first, second)
            if not _BASELINE_M[0] < apart < _BASELINE_M[1]:
                continue
            assert first.features is not None
            assert second.features is not None
            seen = match(first.features, second.features)
            if seen is None:
                continue
            image = second.view.image
            middle = np.array([image.width_px, image.height_px]) / 2  # all copies have one size
            moved_px = math.hypot(*(seen.turn[:, :2] @ middle + seen.turn[:, 2] - middle))
            estimate = second.analysis.estimate
            scales = {each.kind: each.gsd_m_per_px for each in estimate.rulers} | {"all rulers": estimate.gsd_m_per_px}
            for kind, gsd in scales.items():
                if gsd is not None:
                    ratios.setdefault(kind, []).append(apart / (moved_px * gsd))
    print("| scale | pairs | median of positions over scale | quartiles | standard error of the median |")
    print("|---|---|---|---|---|")
    for kind, values in ratios.items():
        low, middle_ratio, high = np.quantile(values, (0.25, 0.5, 0.75))
        error = _MEDIAN_ERROR * (high - low) / _QUARTILES_SD / math.sqrt(len(values))
        print(f"| {kind} | {len(values)} | {middle_ratio:.3f} | {low:.3f} to {high:.3f} | {error:.3f} |")


def _apart_m(first: Photograph, second: Photograph) -> float:
    """Distance between two positions, metres."""
    one, other = first.view.image.camera, second.view.image.camera
    assert one is not None
    assert other is not None
    assert one.latitude_deg is not None
    assert one.longitude_deg is not None
    assert other.latitude_deg is not None
    assert other.longitude_deg is not None
    east = (other.longitude_deg - one.longitude_deg) * math.cos(math.radians(one.latitude_deg))
    return _METRES_A_DEGREE * math.hypot(east, other.latitude_deg - one.latitude_deg)


def oblique(data: Path, cache: Path) -> None:
    """Print rows with metadata, single, linked, and linked with the nadir photographs, and rows without."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    truth = {str(each.path): each.gsd_m_per_px for each in chia_table(data)}
    names = [str(each.path) for each in chia_table(data) if each.pitch_deg > _NADIR_DEG]
    every = [searched(name, name, detector, cache) for name in truth]
    whole = [each for each in every if each.name in names]
    bare_options = ScaleOptions.of({"metadata": False})
    bare = [searched(name, name, detector, cache, bare_options) for name in names]
    _print_heads("photographs, metadata")
    print(_own_row("each alone, whole", whole, truth))
    print(row("linked, whole", conclude(whole, detector.card, same_scale=False), truth))
    print(row("linked with 26 at nadir, whole", conclude(every, detector.card, same_scale=False), truth))
    print(_own_row("each alone, without", bare, truth))
    print(row("linked, without", conclude(bare, detector.card, same_scale=False), truth))


def _own_row(label: str, photographs: Sequence[Photograph], truth: dict[str, float]) -> str:
    own = [(each.analysis.estimate, truth[each.name]) for each in photographs]
    errors = [(each.status, each.gsd_m_per_px / right - 1) for each, right in own if each.gsd_m_per_px is not None]
    usable = [error for status, error in errors if status == "ok"]
    others = [error for status, error in errors if status != "ok"]
    reasons = [each.reason or "ok" for each, _ in own]
    counts = ", ".join(f"{reasons.count(each)} {each}" for each in dict.fromkeys(reasons))
    wrong = sum(abs(error) > 0.2 for error in usable)
    return f"| {label} | {len(usable)} of {len(own)} | {_range(usable)} | {_range(others)} | {wrong} | {counts} |"


def outlines(data: Path, cache: Path) -> None:
    """Print the areas of each outline: by its two photographs alone, by two flights, and by one flight of all."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    photographs = {
        each.path.name: searched(str(each.path), str(each.path), detector, cache) for each in chia_table(data)
    }
    nadir = [each for each in photographs.values() if each.view.tilt is None]
    alone = {name: each.analysis.estimate.gsd_m_per_px for name, each in photographs.items()}
    two = _linked(nadir, detector) | _linked([each for each in photographs.values() if each not in nadir], detector)
    one = _linked(list(photographs.values()), detector)
    print("| outline | nadir | oblique | nadir, m2 | alone: oblique over nadir, % | two flights, % | one flight, % |")
    print("|---|---|---|---|---|---|---|")
    known, off = (alone, two, one), []
    for each in json.loads(_OUTLINES.read_text())["outlines"]:
        areas = np.array(
            [
                [_area(photographs[each[kind]], np.array(each[f"{kind}_px"]), scales[each[kind]]) for scales in known]
                for kind in ("nadir", "oblique")
            ]
        )
        off.append(100 * (areas[1] / areas[0] - 1))
        said = " | ".join(f"{error:+.1f}" for error in off[-1])
        print(f"| {each['name']} | {each['nadir']} | {each['oblique']} | {areas[0, -1]:.1f} | {said} |")
    middle = " | ".join(f"{error:.1f}" for error in np.median(np.abs(off), axis=0))
    print(f"| median of {len(off)}, absolute | | | | {middle} |")


def _linked(photographs: Sequence[Photograph], detector: Detector) -> dict[str, float | None]:
    """Scales of a flight by file."""
    record = conclude(photographs, detector.card, same_scale=False)
    return {Path(each.photograph).name: each.gsd_m_per_px for each in record.photographs}


def _area(photograph: Photograph, outline: NDArray[np.float64], gsd_m_per_px: float | None) -> float:
    """Area of an outline with a scale at the photograph's centre, square metres."""
    assert gsd_m_per_px is not None
    tilt = photograph.view.tilt
    above = outline if tilt is None else tilt.plane(photograph.view.image).from_above(outline)
    x, y = above.T * gsd_m_per_px
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def rendered(cache: Path, flights: int) -> None:
    """Print rows for each scale: no car, and one false vehicle in one photograph."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    _print_heads("scale, flight, vehicles")
    for gsd in _RENDERED_GSD:
        for seed in range(flights):
            photographs, truth = _rendered_flight(gsd, seed, detector, cache)
            wrong = photographs[_PHOTOGRAPHS // 2]
            false = _with_false_vehicle(wrong, truth[wrong.name])
            for label, members in (
                ("none", photographs),
                ("one false", [false if each is wrong else each for each in photographs]),
            ):
                record = conclude(members, detector.card, same_scale=False)
                print(row(f"{gsd:g}, {seed}, {label}", record, truth), flush=True)


def _rendered_flight(
    gsd: float, seed: int, detector: Detector, cache: Path
) -> tuple[list[Photograph], dict[str, float]]:
    """Photographs along a strip, with heights and positions that are as wrong as a small drone's."""
    rng = np.random.default_rng([seed, round(1000 * gsd), 20261123])
    width, height = _SIZE
    margin = width // 5
    size = width + _STEP * (_PHOTOGRAPHS - 1) + 2 * margin, height + 2 * margin
    ground = render_scene(gsd, width_px=size[0], height_px=size[1], seed=3200 + seed, n_vehicles=0).image
    common = float(np.exp(rng.normal(0, _HEIGHT_SD)))
    photographs, truth = [], {}
    for place in range(_PHOTOGRAPHS):
        scale, turn = float(np.exp(rng.normal(0, 0.015))), float(rng.normal(0, 3))
        x, y = margin + width / 2 + place * _STEP, size[1] / 2
        move = cv2.getRotationMatrix2D((x, y), turn, 1 / scale)
        move[:, 2] += np.array([width / 2 - x, height / 2 - y])
        image = cv2.warpAffine(ground, move, _SIZE, flags=cv2.INTER_LINEAR)
        noisy = np.clip(image + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)
        name = f"{gsd:g}_{seed}_{place}.png"
        truth[name] = gsd * scale
        focal = _FOCAL_SHARE * width
        east, north = x * gsd + rng.normal(0, _POSITION_SD_M), -y * gsd + rng.normal(0, _POSITION_SD_M)
        camera = CameraMetadata(
            height_m=truth[name] * focal * common,
            height_tag="rendered height",
            focal_px=focal,
            taken_width_px=width,
            taken_height_px=height,
            off_nadir_deg=0.0,
            latitude_deg=5.0 + north / _METRES_A_DEGREE,
            longitude_deg=-74.0 + east / (_METRES_A_DEGREE * math.cos(math.radians(5.0))),
            altitude_m=2500.0 + truth[name] * focal * common,
        )
        photographs.append(with_camera(searched(name, noisy, detector, cache), camera))
    return photographs, truth


def _with_false_vehicle(photograph: Photograph, gsd: float) -> Photograph:
    """One sure vehicle as long as makes the scale 3.4 times too coarse, and no other."""
    length = 4.6 / (_FALSE_RATIO * gsd)
    found = Detections(np.array([[900.0, 700.0, length, 0.42 * length, 0.3]]), np.array([0.8]))
    return with_camera(photograph, photograph.view.image.camera, found)


def cost(number: int, cache: Path) -> None:
    """Print CPU seconds and memory of a flight of so many photographs of 12 Mpx while it grows, linked and resumed.

    Args:
        number: photographs; the first rows are a quarter and a half of them.
        cache: folder that keeps the rendered photographs.
    """
    detector = Engine(runtime=Runtime(threads=1)).detector
    print("| photographs | CPU s a photograph | held MiB | peak MiB |")
    print("|---|---|---|---|")
    taken = [InputPhotograph(name, name) for name in _rendered_strips(number, cache / "12mpx")]
    found: list[Photograph | Failure] = []
    with tempfile.TemporaryDirectory() as folder:
        journal = open_journal(Path(folder) / "journal", detector, ScaleOptions(), {})
        for n in (number // 4, number // 2, number):
            new = taken[len(found) : n]
            with _measured(f"{n} searched", len(new)):
                found += search_flight(new, detector, ScaleOptions(), featured=True, journal=journal)
        with _measured(f"{number} linked", number):
            conclude(found, detector.card, same_scale=False)
        found.clear()
        with _measured(f"{number} resumed", number):
            found += search_flight(taken, detector, ScaleOptions(), featured=True, journal=journal)


def _rendered_strips(number: int, folder: Path) -> list[str]:
    """Write photographs of 4000 x 3000 px along strips of ten, a quarter of the width apart, if they are not there."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [folder / f"{place:03}.jpg" for place in range(number)]
    for strip in range(math.ceil(number / _STRIP)):
        own = names[_STRIP * strip : _STRIP * (strip + 1)]
        if all(name.exists() for name in own):
            continue
        ground = render_scene(0.02, width_px=3000 + 1000 * _STRIP, height_px=3000, seed=3200 + strip).image
        for place, name in enumerate(own):
            cv2.imwrite(str(name), ground[:, 1000 * place : 1000 * place + 4000, ::-1])
    return [str(name) for name in names]


@contextmanager
def _measured(label: str, number: int) -> Iterator[None]:
    """Print a row: CPU seconds for each of so many photographs, and the memory held at the end and at the peak."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    begun = time.process_time()
    yield
    spent, peak = (time.process_time() - begun) / number, _memory_mib("VmHWM")
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # without it, memory that is free in the process counts
    print(f"| {label} | {spent:.2f} | {_memory_mib('VmRSS'):.0f} | {peak:.0f} |", flush=True)


def _memory_mib(name: str) -> float:
    return int(Path("/proc/self/status").read_text().split(f"{name}:")[1].split()[0]) / 1024


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("chia", "baselines", "oblique", "outlines", "rendered", "cost"))
    parser.add_argument("data", type=Path, nargs="?", default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path("flight_cache"), help="folder that keeps the searches")
    parser.add_argument("--flights", type=int, default=2, help="rendered: flights of each scale")
    parser.add_argument("--photographs", type=int, default=8, help="cost: photographs of the flight")
    arguments = add_record_option(parser).parse_args()
    with recording("flights", [_KEYS.get(arguments.what, arguments.what)], arguments.record):
        if arguments.what == "rendered":
            rendered(arguments.cache, arguments.flights)
        elif arguments.what == "cost":
            cost(arguments.photographs, arguments.cache)
        else:
            named = {"chia": chia, "baselines": baselines, "oblique": oblique, "outlines": outlines}
            named[arguments.what](arguments.data, arguments.cache)


if __name__ == "__main__":
    main()
