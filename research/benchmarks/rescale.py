"""Measure ``vehanchor rescale``.

``python -m research.benchmarks.rescale {rendered,chia,garfield} DATA [--flights N] [--cache FOLDER]``.

``rendered`` photographs rendered places from four poses, 0 to 35 degrees off nadir, and writes models in random units;
the length of the fleet is given, and the last row draws its error as the method assumes it. ``chia`` reconstructs the
57 photographs of DATA/chia with COLMAP (``pip install pycolmap``), scales the model by random factors, and compares the
factor with the GPS track and the cameras' heights with the recorded ones. ``garfield`` does the same with
DATA/flights/garfield. Reconstructions and searches are kept in the cache.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast, get_args

import cv2
import numpy as np
from PIL import Image

from research.results.record import add_record_option, header, recording
from vehanchor.engine import Engine
from vehanchor.flight.reconstruction.estimate import conclude_model, open_model_journal, search_model
from vehanchor.flight.reconstruction.files import read_model, write_rescaled
from vehanchor.flight.reconstruction.ground import model_plane
from vehanchor.flight.reconstruction.photograph import SeenPhotograph
from vehanchor.imagery.identity import Source
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor_scenes import render_scene
from vehanchor_scenes.truth import Layout

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.flight.photograph import StoredPhotograph
    from vehanchor.records import ModelScale
    from vehanchor.storage.journal import Journal

_WORLD_GSD, _WORLD_PX = 0.05, 4000
_SIZE, _FOCAL_PX, _PHOTOGRAPHS = (1600, 1200), 1200.0, 4
_MODE_OVER_MEAN = 1.01  # of a rendered fleet's lengths
_POINTS, _POINT_SD_M = 4000, 0.05  # of a rendered model
_METRES_A_DEGREE = 111_195.0
_MOST_FEATURES, _NEIGHBOURS, _MOST_APART_M = 4000, 20, 500.0  # of a photograph, for COLMAP
_PLAIN = ScaleOptions.of({"metadata": False})
_FACTORS = 5  # random sizes of a real model
_DRAWS = np.random.default_rng(32).normal(size=2000)


class Pose(NamedTuple):
    """Camera above flat ground: metres right of, below and above the upper left corner of the ground, and rotation."""

    x_m: float
    y_m: float
    height_m: float
    rotation: NDArray[np.float64]

    @property
    def translation(self) -> NDArray[np.float64]:
        """Of the ground's corner in the camera's frame, metres."""
        return np.asarray(-self.rotation @ [self.x_m, -self.y_m, self.height_m])

    def photograph(self, ground: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The ground, seen through a pinhole."""
        width, height = _SIZE
        matrix = np.array([[_FOCAL_PX, 0, width / 2], [0, _FOCAL_PX, height / 2], [0, 0, 1]])
        plane = np.column_stack([self.rotation[:, :2], self.translation])
        centre = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts from the centre of the first pixel
        seen = np.linalg.inv(centre) @ matrix @ plane @ np.diag([_WORLD_GSD, -_WORLD_GSD, 1.0]) @ centre
        return np.asarray(cv2.warpPerspective(ground, seen, _SIZE, flags=cv2.INTER_AREA), np.uint8)


def _pose(rng: np.random.Generator) -> Pose:
    """A camera that looks at the middle of the ground."""
    tilt, yaw = math.radians(rng.uniform(0, 35)), rng.uniform(0, 2 * math.pi)
    lean = np.array([[1, 0, 0], [0, math.cos(tilt), math.sin(tilt)], [0, -math.sin(tilt), math.cos(tilt)]])
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1]])
    rotation = np.asarray(lean @ np.diag([1.0, -1.0, -1.0]) @ turn)
    height = rng.uniform(60, 100)
    x, y = np.array([100.0, 100.0]) + rng.uniform(-25, 25, 2)
    ahead = rotation.T @ [0.0, 0.0, 1.0]  # the axis of the camera
    reach = height / -ahead[2]
    return Pose(x - reach * ahead[0], y + reach * ahead[1], height, rotation)


def rendered_project(folder: Path, seed: int) -> tuple[float, float]:
    """Write a project of OpenSfM, if it is not there; return metres a unit and the modal length of the fleet."""
    rng = np.random.default_rng([seed, 20261123])
    unit, mean_length = float(np.exp(rng.uniform(-3, 3))), float(rng.uniform(4.3, 4.9))
    layouts = [each for each in get_args(Layout) if each != "pitches"]
    poses = [_pose(rng) for _ in range(_PHOTOGRAPHS)]
    if (folder / "reconstruction.json").is_file():
        return unit, _MODE_OVER_MEAN * mean_length
    (folder / "images").mkdir(parents=True, exist_ok=True)
    ground = render_scene(
        _WORLD_GSD,
        width_px=_WORLD_PX,
        height_px=_WORLD_PX,
        seed=5200 + seed,
        mean_vehicle_length_m=mean_length,
        layout=cast("Layout", layouts[seed % len(layouts)]),
    ).image
    shots = {}
    for number, pose in enumerate(poses):
        image = pose.photograph(ground) + rng.normal(0, 2, (*_SIZE[::-1], 3))
        cv2.imwrite(str(folder / "images" / f"{number}.jpg"), np.clip(image, 0, 255).astype(np.uint8)[:, :, ::-1])
        rotation = cv2.Rodrigues(pose.rotation)[0].ravel().tolist()
        shots[f"{number}.jpg"] = {
            "camera": "lens",
            "rotation": rotation,
            "translation": (pose.translation / unit).tolist(),
        }
    places = rng.uniform(0, _WORLD_GSD * _WORLD_PX, (_POINTS, 2)) * [1, -1]
    points = np.column_stack([places, rng.normal(0, _POINT_SD_M, _POINTS)]) / unit
    lens = {"projection_type": "perspective", "width": _SIZE[0], "height": _SIZE[1], "focal": _FOCAL_PX / max(_SIZE)}
    part = {
        "cameras": {"lens": {**lens, "k1": 0.0, "k2": 0.0}},
        "shots": shots,
        "points": {str(k): {"coordinates": each.tolist(), "color": [0, 0, 0]} for k, each in enumerate(points)},
    }
    (folder / "reconstruction.json").write_text(json.dumps([part]), encoding="utf-8")
    return unit, _MODE_OVER_MEAN * mean_length


def searched(project: Path, images: Path, detector: Detector, kept: Path) -> Journal[StoredPhotograph]:
    """The searched photographs of a model, in a journal that stays."""
    model = read_model(project)
    journal = open_model_journal(kept, model, detector, _PLAIN, {})
    search_model(model, images, detector, _PLAIN, {}, journal)
    return journal


def estimated(
    project: Path, images: Path, card: DetectorCard, found: Journal[StoredPhotograph], options: ScaleOptions = _PLAIN
) -> ModelScale:
    """The size of a model of these photographs, whatever its unit."""
    model = read_model(project)
    whole, results = model_plane(model), []
    for shot in model.shots:
        kept = found.get((shot.name, *Source.of(images / shot.name)))
        if kept is not None:
            points = model.points[shot.sees(model.points)]
            results.append(SeenPhotograph.of(kept, shot, points, whole, card, options))
    return conclude_model(model, results, images)


class Outcome(NamedTuple):
    """Size of a rendered flight against the truth."""

    seed: int
    found: ModelScale
    unit: float

    @property
    def error(self) -> float:
        """Relative error of the factor."""
        assert self.found.factor is not None
        return self.found.factor / self.unit - 1

    @property
    def width(self) -> float:
        """Half of the interval over the factor."""
        low, high = self.found.factor_ci95_low, self.found.factor_ci95_high
        assert low is not None
        assert high is not None
        assert self.found.factor is not None
        return (high - low) / self.found.factor / 2

    @property
    def holds(self) -> bool:
        """Whether the interval holds the truth."""
        return (self.found.factor_ci95_low or 0) <= self.unit <= (self.found.factor_ci95_high or 0)

    def holds_shifted(self, errors: NDArray[np.float64]) -> float:
        """Share of log errors of the given length with which the interval holds the truth."""
        low, high = self.found.factor_ci95_low, self.found.factor_ci95_high
        if low is None or high is None:
            return 0.0
        return float(np.mean((math.log(low / self.unit) + errors <= 0) & (math.log(high / self.unit) + errors >= 0)))

    @property
    def rulers(self) -> list[str]:
        """Kinds of the rulers behind the factor."""
        return [each.kind for each in self.found.rulers if each.weight > 0]

    def row(self) -> str:
        """A row of the table."""
        rulers = ", ".join(self.rulers)
        numbers = f"{self.found.n_vehicles} | {100 * self.error:+.1f} | {100 * self.width:.1f}"
        state = self.found.reason or self.found.status
        return f"| {self.seed} | {rulers} | {numbers} | {'yes' if self.holds else 'no'} | {state} |"


def rendered(cache: Path, flights: int) -> None:
    """Print a row for each flight, and rows for all."""
    detector = Engine(runtime=Runtime(threads=1)).detector
    print(header("flight", "rulers", "cars", "error, %", "95 % interval, +- %", "holds", "status"))
    outcomes = []
    for seed in range(flights):
        folder = cache / f"rendered_{seed}"
        unit, length = rendered_project(folder, seed)
        options = _PLAIN.with_keywords({"reference_length_m": length})
        with searched(folder, folder / "images", detector, folder / "journal") as journal:
            found = estimated(folder, folder / "images", detector.card, journal, options)
        if found.factor is None:
            print(f"| {seed} | | 0 | - | - | - | {found.status} |", flush=True)
            continue
        outcomes.append(Outcome(seed, found, unit))
        print(outcomes[-1].row(), flush=True)
    usable = [each for each in outcomes if each.found.status == "ok"]
    by_cars = [each for each in usable if each.rulers == ["vehicles"]]
    _print_all("all", outcomes)
    _print_all("ok", usable)
    _print_all("ok, by cars alone", by_cars)
    log_sd = detector.card.reference_length_sd_m / 2 / detector.card.reference_length_m
    share = np.mean([each.holds_shifted(log_sd * _DRAWS) for each in by_cars])
    print(f"| by cars, the length off by {100 * log_sd:.1f} % as assumed | | | | | {100 * share:.0f} % | |")


def _print_all(label: str, outcomes: Sequence[Outcome]) -> None:
    """Print the medians of flights."""
    errors = 100 * np.array([each.error for each in outcomes])
    cars = np.median([each.found.n_vehicles for each in outcomes])
    again = np.median(np.abs(errors)[np.random.default_rng(32).integers(len(errors), size=(2000, len(errors)))], axis=1)
    middle = f"{np.median(np.abs(errors)):.1f} +- {again.std():.1f} (mean {errors.mean():+.1f}, "
    middle += f"largest {np.abs(errors).max():.1f})"
    width = 100 * np.median([each.width for each in outcomes])
    holds = sum(each.holds for each in outcomes)
    print(f"| {label} | | {cars:.0f} | {middle} | {width:.1f} | {holds} of {len(outcomes)} | |")


def colmap_model(images: Path, names: Sequence[str], folder: Path) -> Path | None:
    """Reconstruct photographs with COLMAP, if that was not done; None if it finds no model of half of them.

    Args:
        images: folder of the photographs.
        names: their names in it.
        folder: for the database and the models.
    """
    import pycolmap

    model = folder / "model"
    if model.is_dir():
        return model
    folder.mkdir(parents=True, exist_ok=True)
    database = folder / "database.db"
    pycolmap.set_random_seed(0)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.max_image_size, extraction.sift.max_num_features = 1, 1600, _MOST_FEATURES
    sizes: dict[tuple[int, int], list[str]] = {}
    for name in names:
        with Image.open(images / name) as image:
            sizes.setdefault(image.size, []).append(name)
    for group in sizes.values():  # the copies of one camera have one calibration for each size
        pycolmap.extract_features(
            database, images, image_names=group, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction
        )
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = 1
    near = pycolmap.SpatialPairingOptions()
    near.num_threads, near.max_num_neighbors, near.max_distance = 1, _NEIGHBOURS, _MOST_APART_M
    pycolmap.match_spatial(database, matching_options=matching, pairing_options=near)
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = 1
    (folder / "models").mkdir(exist_ok=True)
    found = pycolmap.incremental_mapping(database, images, folder / "models", options=mapping)
    largest = max(found.values(), key=lambda each: each.num_reg_images(), default=None)
    if largest is None or largest.num_reg_images() < len(names) / 2:
        return None
    model.mkdir()
    largest.write_binary(model)
    return model


def similarity(points: NDArray[np.float64], targets: NDArray[np.float64]) -> tuple[float, float]:
    """Least-squares scale from points ``[n, 3]`` to targets (Umeyama 1991), and the median distance that remains."""
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    u, sizes, v = np.linalg.svd(b.T @ a / len(a))
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
    scale = float(sizes @ sign / (a**2).sum(axis=1).mean())
    left = b - scale * a @ (u * sign @ v).T
    return scale, float(np.median(np.linalg.norm(left, axis=1)))


def real(images: Path, positions: dict[str, NDArray[np.float64]], heights: dict[str, float], cache: Path) -> None:
    """Print a row for each size that is given to the model of COLMAP."""
    project = colmap_model(images, sorted(positions), cache / "colmap")
    if project is None:
        print("COLMAP finds no model of half of the photographs")
        return
    model = read_model(project)
    shots = [shot for shot in model.shots if shot.name in positions]
    track = np.array([positions[shot.name] for shot in shots])
    scale, left = similarity(np.array([shot.centre for shot in shots]), track)
    print(f"{len(shots)} of {len(positions)} photographs in the model; the track fits within {left:.1f} m (median)")
    detector = Engine(runtime=Runtime(threads=1)).detector
    print(header("times", "factor over that of the track, %", "95 % interval, %", "cars", "status", "heights, %"))
    rng = np.random.default_rng(32)
    with searched(project, images, detector, cache / "journal") as journal:
        for times in (1.0, *np.exp(rng.uniform(-3, 3, _FACTORS - 1))):
            folder = cache / f"times_{times:.4g}"
            if not folder.is_dir():
                write_rescaled(model, folder, times)
            found = estimated(folder, images, detector.card, journal)
            print(_real_row(found, float(times), scale, heights), flush=True)


def _real_row(found: ModelScale, times: float, scale: float, heights: dict[str, float]) -> str:
    if found.factor is None or found.factor_ci95_low is None or found.factor_ci95_high is None:
        return f"| {times:.4g} | - | - | 0 | {found.reason or found.status} | - |"
    off, low, high = (
        100 * (each * times / scale - 1) for each in (found.factor, found.factor_ci95_low, found.factor_ci95_high)
    )
    above = [
        100 * (each.camera_height * found.factor / heights[each.photograph] - 1)
        for each in found.photographs
        if each.camera_height is not None and each.photograph in heights
    ]
    middle = "-" if not above else f"{np.median(above):+.1f} ({min(above):+.1f} to {max(above):+.1f})"
    state = f"{found.status}, {found.reason}" if found.reason else found.status
    return f"| {times:.4g} | {off:+.1f} | {low:+.1f} to {high:+.1f} | {found.n_vehicles} | {state} | {middle} |"


def _metres(rows: Sequence[dict[str, str]], up: str) -> NDArray[np.float64]:
    """Positions ``[n, 3]`` in metres east, north and up of the first."""
    at = np.array([[float(row[name]) for name in ("longitude_deg", "latitude_deg", up)] for row in rows])
    across = math.cos(math.radians(at[0, 1]))
    return np.asarray((at - at[0]) * [_METRES_A_DEGREE * across, _METRES_A_DEGREE, 1.0])


def _rows(table: Path) -> list[dict[str, str]]:
    with table.open() as file:
        return list(csv.DictReader(file))


def chia(data: Path, cache: Path) -> None:
    """The photographs of DATA/chia."""
    rows = _rows(data / "chia" / "table.csv")
    places = _metres(rows, "height_above_takeoff_m")
    positions = {row["file"]: place for row, place in zip(rows, places, strict=True)}
    heights = {row["file"]: float(row["height_above_takeoff_m"]) for row in rows}
    real(data / "chia", positions, heights, cache / "chia")


def garfield(data: Path, cache: Path) -> None:
    """The photographs of DATA/flights/garfield."""
    rows = [row for row in _rows(data / "flights" / "table.csv") if row["flight"] == "garfield"]
    positions = dict(zip([row["file"] for row in rows], _metres(rows, "altitude_above_sea_m"), strict=True))
    real(data / "flights", positions, {}, cache / "garfield")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("rendered", "chia", "garfield"))
    parser.add_argument("data", type=Path, nargs="?", default=Path("../shared/data"))
    parser.add_argument("--cache", type=Path, default=Path("rescale_cache"), help="keeps reconstructions and searches")
    parser.add_argument("--flights", type=int, default=24, help="rendered: number of flights")
    chosen: Any = add_record_option(parser).parse_args()
    with recording("flights", [f"rescale_{chosen.what}"], chosen.record):
        if chosen.what == "rendered":
            rendered(chosen.cache, chosen.flights)
        else:
            {"chia": chia, "garfield": garfield}[chosen.what](chosen.data, chosen.cache)


if __name__ == "__main__":
    main()
