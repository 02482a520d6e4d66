"""Measure tilted cameras: ``python -m research.benchmarks.tilt {warped,courts,real,nadir} DATA [--cache FOLDER]``.

``warped`` warps orthophotos of known scale by known homographies (pitch -90 to -45, roll within 10 degrees, three focal
lengths): the tilt by cars, by metadata (angles off by a degree or so, the height by 5 %) and by both; areas of
rectangles anywhere in the frame, treated and not. ``courts`` does so with rendered sports grounds, one whole court in
each image, and no metadata. ``real`` reads the eight pitches of DATA/tilt. ``nadir`` counts nadir images that
are taken for tilted ones.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.benchmarks.flights import read, spoiled
from research.results.record import add_record_option, recording
from vehanchor.analysis.pipeline import analyse_detections
from vehanchor.analysis.stored import stored_classes
from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import SceneScalePrior, load_scene_scale
from vehanchor.detection.search import search
from vehanchor.engine import Engine
from vehanchor.errors import TooObliqueError
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.facts import ImageFacts, image_facts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import equivalent_lens
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.view import View
from vehanchor.scale.plane import GroundPlane
from vehanchor.storage.codec import Codec
from vehanchor.tilt.camera_tilt import NADIR_TOLERANCE_DEG, plane_of_record
from vehanchor.tilt.estimate import NEARLY_CERTAIN, tilt_from_vehicles
from vehanchor.tilt.vehicle_cue import LEAST_CARS
from vehanchor_scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.records import GsdEstimate

_TILTS_DEG = (0.0, 10.0, 15.0, 20.0, 30.0, 40.0, 45.0)
_COURT_TILTS_DEG = (0.0, 15.0, 30.0, 45.0)
_FOCALS_35MM = (20.0, 26.0, 35.0)
_WIDEST_AT_DEG = 40.0  # beyond, the widest lens has the horizon nearly visible, and is refused
_SIZE = (800, 600)
_LEAST_LABELLED = 40
_ANGLE_SD, _HEIGHT_LOG_SD = 1.0, 0.05  # of the metadata that are made up
_OBJECTS = 8  # rectangles in a frame
_SIDES_M = (6.0, 30.0)
_MOST_HIDDEN = 0.05  # of a court, by trees
_CLEAR_PX = 12.0  # between a court and the image's edge
_TAKEN_FOR_TILTED_DEG = 8.0
_CANNES_COLUMNS = 49


class Aside(NamedTuple):
    """A tilted view with its truth, its detections and its scene-scale prior."""

    image: NDArray[np.uint8]
    plane: GroundPlane
    detections: Detections
    prior: SceneScalePrior | None = None


def looked_at(
    image: ImageSource, detector: Detector, cache: Path | None
) -> tuple[ImageFacts, Detections, SceneScalePrior | None]:
    """Facts, detections and prior of an image, from the cache if it was searched before."""
    with open_raster(image) as raster:
        facts = image_facts(raster)
        key = hashlib.sha256(f"{detector.card.sha256} {facts.image_id}".encode()).hexdigest()[:24]
        known = None if cache is None else cache / f"seen_{key}.json"
        if known is not None and known.exists():
            detections, prior = Codec(stored_classes()).load(json.loads(known.read_text()))
            return facts, detections, prior
        network = load_scene_scale(detector.runtime)
        prior = None if network is None else network.predict(raster)
        detections = search(raster, detector, ScaleOptions().search, prior=prior)
    if known is not None:
        known.parent.mkdir(parents=True, exist_ok=True)
        known.write_text(json.dumps(Codec(stored_classes()).dump((detections, prior))))
    return facts, detections, prior


def seen_aside(ground: NDArray[np.uint8], plane: GroundPlane, aim: ArrayLike | None = None) -> NDArray[np.uint8]:
    """Project an orthophoto into a tilted view with the same scale at the centre; beyond its edges it is mirrored.

    Args:
        ground: ``[h, w, 3]`` from straight above.
        plane: where the camera stands.
        aim: place of the ground, x and y in its pixels, that the image's centre shows; None has it see as much of the
            ground as may be.
    """
    corners = np.array([(0.0, 0.0), (plane.width_px, 0.0), (plane.width_px, plane.height_px), (0.0, plane.height_px)])
    seen = plane.from_above(corners)
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    there = seen + np.asarray(aim) if aim is not None else seen - middle + np.array(ground.shape[1::-1]) / 2
    move = cv2.getPerspectiveTransform(there.astype(np.float32), corners.astype(np.float32))
    size = plane.width_px, plane.height_px
    smooth = cv2.GaussianBlur(ground, (0, 0), 0.5) if plane.tilt_deg > 0 else ground
    return np.asarray(cv2.warpPerspective(smooth, move, size, borderMode=cv2.BORDER_REFLECT_101), dtype=np.uint8)


def rectangles(plane: GroundPlane, rng: np.random.Generator) -> Iterator[tuple[NDArray[np.bool_], float]]:
    """Masks of rectangles on the ground that lie whole in the frame, and their areas, square metres."""
    made = 0
    while made < _OBJECTS:
        middle = rng.uniform((0, 0), _SIZE)
        sides, turn = rng.uniform(*_SIDES_M, 2), rng.uniform(0, np.pi)
        ways = np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))]) * sides[:, None] / 2
        outline = np.array([a * ways[0] + b * ways[1] for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        points = _in_image(plane, plane.from_above([middle])[0] + outline / plane.gsd_m_per_px)
        if (points < 1).any() or (points > np.array(_SIZE) - 1).any():
            continue
        mask = np.zeros(_SIZE[::-1], np.uint8)
        cv2.fillPoly(mask, [np.rint((points - 0.5) * 16).astype(np.int32)], 1, shift=4)
        if int(mask.sum()) < 150:
            continue
        made += 1
        yield mask.astype(bool), float(sides.prod())


def _in_image(plane: GroundPlane, above: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert ``GroundPlane.from_above``."""
    corners = np.array([(0.0, 0.0), (plane.width_px, 0.0), (plane.width_px, plane.height_px), (0.0, plane.height_px)])
    move = cv2.getPerspectiveTransform(plane.from_above(corners).astype(np.float32), corners.astype(np.float32))
    return np.asarray(cv2.perspectiveTransform(above[None], move)[0], dtype=np.float64)


def estimated(
    aside: Aside, camera: CameraMetadata | None, detector: Detector, options: ScaleOptions | None = None
) -> GsdEstimate | None:
    """The record of an image; None where it is refused."""
    with open_raster(aside.image) as raster:
        facts = ImageFacts(raster.width_px, raster.height_px, camera=camera)
        share = partial(resolved_share, raster)
        view = View(facts, aside.detections, detector.card, options or ScaleOptions(), share, raster, prior=aside.prior)
        try:
            return analyse_detections(view).estimate
        except TooObliqueError:
            return None


def told(plane: GroundPlane, rng: np.random.Generator) -> CameraMetadata:
    """Camera metadata with drawn errors."""
    return CameraMetadata(
        height_m=plane.height_m * float(np.exp(rng.normal(0, _HEIGHT_LOG_SD))),
        height_tag="RelativeAltitude",
        focal_px=plane.focal_px,
        taken_width_px=plane.width_px,
        taken_height_px=plane.height_px,
        off_nadir_deg=abs(plane.tilt_deg + float(rng.normal(0, _ANGLE_SD))),
        roll_deg=plane.roll_deg + float(rng.normal(0, _ANGLE_SD)) / max(math.sin(math.radians(plane.tilt_deg)), 0.1),
    )


def orthophotos(data: Path, split: str, number: int) -> list[Path]:
    """Tiles of 0.20 m/px and 1000 px with many labelled cars."""
    with (data / "gsd" / "upright.csv").open() as file:
        listed = [row for row in csv.DictReader(file) if row["set"] == "estonia"]
    full = [row for row in listed if int(row["labelled_small_vehicles"] or 0) >= _LEAST_LABELLED]
    order = sorted(full, key=lambda row: row["split"] != split)
    return [(data / "gsd" / row["file"]).resolve() for row in order][:number]


def warped(data: Path, split: str, number: int, tilts: Sequence[float], detector: Detector, cache: Path | None) -> None:
    """Print the tables of tilted orthophotos."""
    grounds = [(read(path), 0.2) for path in orthophotos(data, split, number)]
    rows = {tilt: [_row(*ground, tilt, seed, detector, cache) for seed, ground in enumerate(grounds)] for tilt in tilts}
    print("| pitch | images | 25 cars | cars alone, focal length known | unknown | warned of | metadata | with cars |")
    print("|---|---|---|---|---|---|---|---|")
    for tilt, found in rows.items():
        cars = [each for each in found if "known" in each]
        values = [_median(cars, name) for name in ("known", "unknown")]
        warned = sum(each["warned"] for each in cars)
        values += [_median(found, name) for name in ("metadata", "joint")]
        cells = [f"{tilt - 90:.0f}", len(found), len(cars), *values[:2], f"{warned:.0f} of {len(cars)}", *values[2:]]
        print("| " + " | ".join(map(str, cells)) + " |")
    print()
    _areas(rows)


def _areas(rows: dict[float, list[dict[str, float]]]) -> None:
    print("| off nadir | images | untreated | treated | by the plane alone | scale at the centre |")
    print("|---|---|---|---|---|---|")
    for tilt, found in rows.items():
        values = [_median(found, name, 100) for name in ("untreated", "treated", "plane", "scale")]
        print(f"| {tilt:.0f} | {len(found)} | " + " | ".join(f"{each} %" for each in values) + " |")


def _median(found: Sequence[dict[str, float]], name: str, factor: float = 1.0) -> str:
    values = [each[name] for each in found if name in each]
    return f"{factor * np.median(values):.1f}" if values else "-"


def _row(
    ground: NDArray[np.uint8], gsd: float, tilt: float, seed: int, detector: Detector, cache: Path | None
) -> dict[str, float]:
    """Errors of one image, degrees and shares."""
    rng = np.random.default_rng([seed, round(tilt), 20261122])
    focal = equivalent_lens(*_SIZE, float(rng.choice(_FOCALS_35MM[tilt > _WIDEST_AT_DEG :]))).pixels
    plane = GroundPlane(gsd, tilt, focal, *_SIZE, float(rng.uniform(-10, 10)))
    image = np.ascontiguousarray(spoiled(seen_aside(ground, plane), rng)[:, :, ::-1])
    aside = Aside(image, plane, *looked_at(image, detector, cache)[1:])
    found: dict[str, float] = {}
    known, unknown = (tilt_from_vehicles(aside.detections, *_SIZE, each) for each in (focal, None))
    if known is not None and unknown is not None:
        found |= {"known": abs(known.tilt_deg - tilt), "unknown": abs(unknown.tilt_deg - tilt)}
        found["warned"] = float(unknown.chance_above(NADIR_TOLERANCE_DEG) >= NEARLY_CERTAIN)
    camera = told(plane, rng)
    bare = ScaleOptions.of({"rulers": ("vehicles", "scene_scale", "camera")})  # no court is in these tiles
    plain = estimated(aside, None, detector, bare)
    record = estimated(aside, camera, detector, bare)
    if record is not None and record.tilt is not None and camera.off_nadir_deg is not None:
        found |= {"metadata": abs(camera.off_nadir_deg - tilt), "joint": abs(record.tilt.tilt_deg - tilt)}
    found |= _off_areas(plane, record, plain, rng)
    return found


def _off_areas(
    plane: GroundPlane, record: GsdEstimate | None, plain: GsdEstimate | None, rng: np.random.Generator
) -> dict[str, float]:
    """Median errors of the areas of one image, each less what the mask's pixels get wrong."""
    treated, untreated, alone = [], [], []
    solved = None if record is None else plane_of_record(record)
    gsd = None if record is None else record.gsd_m_per_px
    for mask, _ in rectangles(plane, rng):
        true = plane.area(mask)  # of these pixels: the mask's own error is no part of it
        if plain is not None and plain.gsd_m_per_px:
            untreated.append(abs(mask.sum() * plain.gsd_m_per_px**2 / true - 1))
        if gsd:
            said = mask.sum() * gsd**2 if solved is None else solved.area(mask)
            treated.append(abs(said / true - 1))
            alone.append(abs(said * (plane.gsd_m_per_px / gsd) ** 2 / true - 1))
    sums = {"untreated": untreated, "treated": treated, "plane": alone}
    found = {name: float(np.median(values)) for name, values in sums.items() if values}
    return found | ({"scale": abs(gsd / plane.gsd_m_per_px - 1)} if gsd else {})


def courts(number: int, tilts: Sequence[float], cpu_s: float, detector: Detector) -> None:
    """Print the table of tilted sports grounds, one whole court in each, without metadata or vehicles.

    Args:
        number: grounds, if they are done in time.
        tilts: degrees from straight down.
        cpu_s: CPU seconds after which no other ground is begun.
        detector: whose size of boxes the search for courts starts from.
    """
    rows: dict[float, list[dict[str, float]]] = {tilt: [] for tilt in tilts}
    begun, seed = time.process_time(), 5000
    while len(rows[tilts[0]]) < number and time.process_time() - begun < cpu_s:
        scene = render_scene(0.1, width_px=1000, height_px=1000, seed=seed, layout="sports")
        seed += 1
        whole = [court.corners for court in scene.courts if not court.cut and court.hidden_share <= _MOST_HIDDEN]
        if whole:
            ground = np.ascontiguousarray(scene.image[:, :, ::-1])
            for tilt in tilts:
                rows[tilt].append(_court_row(ground, whole, tilt, seed, detector))
    print("| pitch | images | scale by courts | tilt found | error of the tilt | not found | horizon doubted |", end="")
    print(" focal length unknown: found | error | CPU s an image |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for tilt, found in rows.items():
        count = {name: sum(name in each for each in found) for name in ("scale", "joint", "refused", "blind")}
        nothing = len(found) - count["scale"] - count["refused"]
        cells = [f"{tilt - 90:.0f}", len(found), count["scale"], count["joint"], _median(found, "joint"), nothing]
        cells += [count["refused"], count["blind"], _median(found, "blind"), _median(found, "cpu")]
        print("| " + " | ".join(map(str, cells)) + " |")
    print()
    _areas({tilt: [each for each in found if "treated" in each] for tilt, found in rows.items()})


def _court_row(
    ground: NDArray[np.uint8], whole: Sequence[NDArray[np.float64]], tilt: float, seed: int, detector: Detector
) -> dict[str, float]:
    """Errors of one view with a whole court, degrees and shares."""
    rng = np.random.default_rng([seed, round(tilt), 20261122])
    focal = equivalent_lens(*_SIZE, float(rng.choice(_FOCALS_35MM[tilt > _WIDEST_AT_DEG :]))).pixels
    plane = GroundPlane(0.1, tilt, focal, *_SIZE, float(rng.uniform(-10, 10)))
    aim = _aim(plane, whole[int(rng.integers(len(whole)))], rng)
    image = np.ascontiguousarray(spoiled(seen_aside(ground, plane, aim), rng)[:, :, ::-1])
    aside = Aside(image, plane, Detections(np.zeros((0, 5)), np.zeros(0)))
    lens = CameraMetadata(focal_px=focal, taken_width_px=_SIZE[0], taken_height_px=_SIZE[1])
    begun = time.process_time()
    record, blind = estimated(aside, lens, detector), estimated(aside, None, detector)
    found = {"cpu": (time.process_time() - begun) / 2}
    found |= {"refused": 1.0} if record is None else {"scale": 1.0} if record.gsd_m_per_px else {}
    found |= _off_areas(plane, record, None, rng)
    if blind is not None and blind.gsd_m_per_px:
        masks = list(rectangles(plane, rng))
        off = [abs(mask.sum() * blind.gsd_m_per_px**2 / plane.area(mask) - 1) for mask, _ in masks]
        found["untreated"] = float(np.median(off))
    for name, each in (("joint", record), ("blind", blind)):
        if each is not None and each.tilt is not None:
            found[name] = abs(each.tilt.tilt_deg - tilt)
    return found


def _aim(plane: GroundPlane, corners: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw the centre's position on the ground so that the image contains a whole court."""
    middle = corners.mean(axis=0)
    for reach in (250.0, 200.0, 150.0, 100.0, 50.0):
        aim = middle + rng.uniform(-reach, reach, 2)
        points = _in_image(plane, corners - aim)
        if (points > _CLEAR_PX).all() and (points < np.array(_SIZE) - _CLEAR_PX).all():
            return np.asarray(aim)
    return np.asarray(middle)


def real(data: Path, detector: Detector, cache: Path | None) -> None:
    """Print the table of the eight photographs of known pitch."""
    with (data / "tilt" / "table.csv").open() as file:
        listed = sorted(csv.DictReader(file), key=lambda row: float(row["camera_pitch_deg"]))
    print("| pitch | tilt used | source | by cars alone | m/px by the height | modal car, m | rulers | status |")
    print("|---|---|---|---|---|---|---|---|")
    for row in listed:
        pitch, path = float(row["camera_pitch_deg"]), data / "tilt" / row["file"]
        facts, detections, prior = looked_at(path, detector, cache)
        alone = tilt_from_vehicles(detections, facts.width_px, facts.height_px)
        said = "-" if alone is None else f"{alone.tilt_deg:.0f} ({alone.low_deg:.0f} to {alone.high_deg:.0f})"
        with open_raster(path) as raster:
            view = View(
                facts, detections, detector.card, ScaleOptions(), partial(resolved_share, raster), raster, prior=prior
            )
            try:
                analysis = analyse_detections(view)
            except TooObliqueError:
                print(f"| {pitch} | refused | | {said} | | | | |", flush=True)
                continue
        record, camera = analysis.estimate, next((each for each in analysis.others if each.kind == "camera"), None)
        by_height = math.nan if camera is None or camera.gsd_m_per_px is None else camera.gsd_m_per_px
        used, source = (f"{record.tilt.tilt_deg:.1f}", record.tilt.source) if record.tilt else ("level", "metadata")
        length = f"{(record.mode_length_px or math.nan) * by_height:.1f} ({record.n_vehicles})"
        heeded = {True: "", False: " (not heeded)"}
        says = ", ".join(f"{each.kind} {each.gsd_m_per_px:.4f}{heeded[each.agrees]}" for each in record.rulers)
        cells = [pitch, used, source, said, f"{by_height:.4f}", length, says, record.status]
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def nadir(data: Path, split: str, least: int, detector: Detector, cache: Path | None) -> None:
    """Count nadir images that are taken for tilted: those with labelled cars, and rows of neighbours."""
    print("| set | images | 25 cars | a tilt in the record | a warning | the same, focal length known | ", end="")
    print("by cars alone, median | 95th percentile |")
    print("|---|---|---|---|---|---|---|---|")
    rows: dict[str, list[dict[str, float]]] = {}
    for name, image in from_above(data, split, least):
        facts, detections, prior = looked_at(image, detector, cache)
        seen = Aside(image, GroundPlane(1.0, 0.0, 1.0, facts.width_px, facts.height_px), detections, prior)
        lens = equivalent_lens(facts.width_px, facts.height_px, _FOCALS_35MM[1]).pixels
        known = CameraMetadata(focal_px=lens, taken_width_px=facts.width_px, taken_height_px=facts.height_px)
        found: dict[str, float] = {}
        for key, camera in (("", None), ("known ", known)):
            record = estimated(seen, camera, detector)
            tilt = None if record is None else record.tilt
            found[key + "tilt"] = float(record is None or (tilt is not None and tilt.tilt_deg > _TAKEN_FOR_TILTED_DEG))
            codes = [] if record is None else [each.code for each in record.warnings]
            found[key + "warned"] = float(NoticeCode.TILT_SUSPECTED in codes)
        alone = tilt_from_vehicles(detections, facts.width_px, facts.height_px)
        rows.setdefault(name, []).append(found | ({} if alone is None else {"alone": alone.tilt_deg}))
    rows["all"] = [each for found in rows.values() for each in found]
    for name, images in rows.items():
        sums = {key: int(sum(each[key] for each in images)) for key in ("tilt", "warned", "known tilt", "known warned")}
        tilts = [each["alone"] for each in images if "alone" in each]
        cells = [name, len(images), len(tilts), sums["tilt"], sums["warned"]]
        cells += [f"{sums['known tilt']} and {sums['known warned']}"]
        cells += [f"{np.median(tilts):.1f}", f"{np.percentile(tilts, 95):.1f}"] if tilts else ["-", "-"]
        print("| " + " | ".join(map(str, cells)) + " |")


def from_above(data: Path, split: str, least: int) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Images with so many labelled cars, RGB, and their sets; neighbours of cannes with 25 cars joined, too."""
    rows = []
    for table in ("table.csv", "upright.csv"):
        with (data / "gsd" / table).open() as file:
            rows += [row for row in csv.DictReader(file) if row["split"] == split]
    cars = {(data / "gsd" / row["file"]).resolve(): int(row["labelled_small_vehicles"] or 0) for row in rows}
    for (path, n), row in zip(cars.items(), rows, strict=True):
        if n >= least:
            yield row["set"], np.ascontiguousarray(read(path)[:, :, ::-1])
    for path in cars:
        if not path.name.startswith("cannes"):
            continue
        first = int(path.stem.split("_")[1])
        for length in (2, 3):
            joined = [path.with_name(f"cannes_{first + k}.jpg") for k in range(length)]
            inside = first % _CANNES_COLUMNS + length < _CANNES_COLUMNS  # the last column is narrower
            if inside and all(each in cars for each in joined) and sum(map(cars.__getitem__, joined)) >= LEAST_CARS:
                yield "cannes joined", np.ascontiguousarray(np.hstack([read(each) for each in joined])[:, :, ::-1])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("warped", "courts", "real", "nadir"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="val", help="of it first; the other one where there are too few")
    parser.add_argument("--cache", type=Path, help="folder that keeps what was found in each image")
    parser.add_argument("--tilts", type=float, nargs="+", help="degrees from straight down")
    parser.add_argument("--images", type=int, default=12, help="grounds that are seen from aside")
    parser.add_argument("--labelled", type=int, default=1, help="nadir: least labelled cars of an image")
    parser.add_argument("--cpu-seconds", type=float, default=900.0, help="courts: then no other ground is begun")
    chosen = add_record_option(parser).parse_args()
    detector = Engine(runtime=Runtime(threads=1)).detector
    keys = {"warped": ["angles", "areas"], "courts": ["courts", "court_areas"], "real": ["photographs"]}
    with recording("tilt", keys.get(chosen.what, [chosen.what]), chosen.record):
        if chosen.what == "warped":
            tilts = chosen.tilts or _TILTS_DEG
            warped(chosen.data, chosen.split, chosen.images, tilts, detector, chosen.cache)
        elif chosen.what == "courts":
            courts(chosen.images, chosen.tilts or _COURT_TILTS_DEG, chosen.cpu_seconds, detector)
        elif chosen.what == "real":
            real(chosen.data, detector, chosen.cache)
        else:
            nadir(chosen.data, chosen.split, chosen.labelled, detector, chosen.cache)


if __name__ == "__main__":
    main()
