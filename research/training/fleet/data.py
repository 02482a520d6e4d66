"""Chips of labelled vehicles with simulated changes of camera."""

from __future__ import annotations

import csv
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.training.detector.data import group_of, read_corrections
from research.training.detector.places import is_held_out, places
from research.training.detector.scenery import SCENERY
from vehanchor.detection.appearance import chip
from vehanchor.detection.boxes import boxes_from_corners
from vehanchor.detection.verifier import CHIP_LENGTH_PX
from vehanchor_evaluation.dota import read_labels

if TYPE_CHECKING:
    from numpy.typing import NDArray

NORTH_AMERICA = "ucm"  # the one set of the train split from there
OTHERS = ("cannes", "saopaulo", "jekhor", "estonia")
SCENES = "scene"  # rendered: of no region, but each car's length is known
MEASURED = ("ucm", "cannes", "saopaulo", "estonia")  # of known scale, so that a car's length in metres is known, too
_STORED_LENGTH_PX = 40.0
_LENGTHS_PX = (11.0, 18.0)  # all are shown at lengths that the coarsest set has, or sharpness would tell the set
_REACH = 2.0  # of a length, around a vehicle's centre
_PER_IMAGE = 25
_FRAMES = 4  # one frame of a video in so many
N_FOLDS = 2


class Vehicle(NamedTuple):
    """One labelled vehicle with its surroundings."""

    set: str
    file: str
    pixels: NDArray[np.uint8]  # [h, w, 3]
    box: NDArray[np.float64]  # [5], in these pixels
    length_m: float | None = None  # None where the scale is not known


def fold_of(file: str, set_name: str) -> int:
    """Return the part of an image by a checksum of its group."""
    return zlib.crc32(f"fold {group_of(file, set_name)}".encode()) % N_FOLDS


def load_vehicles(data: Path) -> list[Vehicle]:
    """Up to 25 vehicles of each train image of ``shared/data``; Estonia's are people's boxes, turned by a detector."""
    rng = np.random.default_rng(0)
    out = []
    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        rows = list(csv.DictReader(handle))
    for k, row in enumerate(rows):
        if row["split"] != "train" or row["set"] not in (NORTH_AMERICA, *OTHERS):
            continue
        if row["set"] == "jekhor" and k % _FRAMES:
            continue
        text = data / "vehicles" / "labels" / f"{Path(row['file']).stem}.txt"
        labels = boxes_from_corners(read_labels(text).of_class("small-vehicle"))
        gsd = float(row["gsd_m_per_px"]) if row["set"] in MEASURED else None
        out += _vehicles(rng, data / "vehicles" / row["file"], row["set"], row["file"], labels, gsd)
    turned = read_corrections(SCENERY)
    for place in places(data):
        if place.set in OTHERS and not is_held_out(place):
            cars = [known.box for known in turned.get(place.path.name, []) if known.kind == "car"]
            labels = np.asarray(cars, np.float64).reshape(-1, 5)
            out += _vehicles(rng, place.path, place.set, place.path.name, labels, place.gsd_m_per_px)
    return out


def load_scene_vehicles(folder: Path) -> list[Vehicle]:
    """Up to 25 vehicles of each rendered scene (``research.training.detector.render_scenes``)."""
    rng = np.random.default_rng(0)
    out = []
    for path in sorted(folder.glob("*.jpg")):
        labels = read_labels(path.with_suffix(".txt"))
        if labels.gsd_m_per_px is not None:
            boxes = boxes_from_corners(labels.of_class("small-vehicle"))
            out += _vehicles(rng, path, SCENES, path.name, boxes, labels.gsd_m_per_px)
    return out


def _vehicles(
    rng: np.random.Generator, path: Path, set_name: str, file: str, boxes: NDArray[np.float64], gsd: float | None
) -> list[Vehicle]:
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    boxes = boxes[((boxes[:, :2] >= 0) & (boxes[:, :2] < image.shape[1::-1])).all(axis=1)]
    chosen = boxes[rng.permutation(len(boxes))[:_PER_IMAGE]]
    return [
        Vehicle(
            set_name,
            file,
            *_surroundings(np.asarray(image, np.uint8), box),
            None if gsd is None else float(box[2]) * gsd,
        )
        for box in chosen
    ]


def _surroundings(image: NDArray[np.uint8], box: NDArray[np.float64]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    reach = _REACH * box[2]
    left, top = (max(0, int(side - reach)) for side in box[:2])
    right, bottom = (int(side + reach) + 1 for side in box[:2])
    pixels, moved = image[top:bottom, left:right], box - [left, top, 0, 0, 0]
    return resized(pixels, moved, min(1.0, _STORED_LENGTH_PX / box[2]))


def beside(vehicle: Vehicle, lengths: float) -> Vehicle:
    """Move a sample beside its vehicle, by multiples of its length: a control without the vehicle."""
    x, y, length, _, angle = vehicle.box
    box = vehicle.box.copy()
    box[:2] = x - lengths * length * np.sin(angle), y + lengths * length * np.cos(angle)
    return vehicle._replace(box=box)


def resized(
    pixels: NDArray[np.uint8], box: NDArray[np.float64], factor: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Pixels and box at another resolution; the factor may be rounded a little differently in x and y."""
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    height, width = pixels.shape[:2]
    new = cv2.resize(pixels, (max(1, round(width * factor)), max(1, round(height * factor))), interpolation=way)
    x, y = new.shape[1] / width, new.shape[0] / height
    return np.asarray(new, np.uint8), box * [x, y, factor, factor, 1]


def vehicle_at_length(vehicle: Vehicle, length_px: float) -> NDArray[np.float32]:
    """Cut a vehicle's chip at another resolution, otherwise unchanged."""
    pixels, box = resized(vehicle.pixels, vehicle.box, length_px / vehicle.box[2])
    return chip(np.ascontiguousarray(pixels[:, :, 1]), box)


def random_chip(vehicle: Vehicle, rng: np.random.Generator) -> tuple[NDArray[np.float32], float]:
    """A chip at a random resolution, of a box a little off, with the tones, the blur and the noise of some camera.

    Returns:
        The chip, and how many times as long as the vehicle's its box is: a detector takes a shadow for part of a car.
    """
    length = rng.uniform(*_LENGTHS_PX)
    pixels, box = resized(vehicle.pixels, vehicle.box, length / vehicle.box[2])
    channel = np.ascontiguousarray(pixels[:, :, rng.integers(3) if rng.random() < 0.3 else 1])
    grey = cv2.GaussianBlur(channel.astype(np.float32), (0, 0), rng.uniform(0.2, 1.0) * length / CHIP_LENGTH_PX)
    if rng.random() < 0.3:  # highlights or shadows without detail
        low, high = np.percentile(grey, [rng.uniform(0, 25), rng.uniform(75, 100)])
        grey = (grey - low) / (high - low + 1) * 255
    grey = 255 * (np.clip(grey, 0, 255) / 255) ** rng.uniform(0.6, 1.6)
    grey += rng.normal(0, rng.uniform(0, 8), grey.shape)
    noisy = np.clip(grey, 0, 255).astype(np.uint8)
    if rng.random() < 0.3:
        quality = (cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 90)))
        noisy = np.asarray(cv2.imdecode(cv2.imencode(".jpg", noisy, quality)[1], cv2.IMREAD_GRAYSCALE), np.uint8)
    off = box.copy()
    off[:2] += rng.normal(0, 0.05 * length, 2)
    off[2] *= rng.uniform(0.88, 1.12)
    off[4] += rng.normal(0, 0.07)
    cut = chip(noisy, off)
    if rng.random() < 0.5:
        cut = cut[::-1]
    if rng.random() < 0.5:
        cut = cut[:, ::-1]
    return np.ascontiguousarray(cut), float(off[2] / box[2])
