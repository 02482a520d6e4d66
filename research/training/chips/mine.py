"""Collect candidates from the train images: ``python -m research.training.chips.mine RUN``.

Writes the stores ``RUN/train`` and ``RUN/held_out``. A chip comes from one of four sources: boxes
that the bundled detector finds at a low score, every labelled car, labelled boxes moved or scaled
until they no longer fit, and lorries. ``looked_at.csv`` lists cars without a label, which count as
cars, and doubtful objects, on which no box counts as false. For the odd numbers of ``chia/crops``,
which ``--native`` adds, it lists all cars.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.training.chips.store import STORED_LENGTH_PX, STORED_PX, UNKNOWN, ChipStore, Rows
from research.training.detector.data import TrainImage, is_dev, load_scenes, load_train_images
from research.training.detector.places import is_held_out, places
from research.training.detector.scenery import CAR_M, load_scenery
from vehanchor.detection.boxes import box_corners, boxes_from_corners, oriented_iou, oriented_nms
from vehanchor.detection.chips import KINDS
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search
from vehanchor_evaluation.dota import read_labels

Boxes: TypeAlias = NDArray[np.float64]
"""Boxes ``[n, 5]``: x, y, length, width, angle."""

Polygons: TypeAlias = NDArray[np.float64]
"""Corners ``[n, 4, 2]`` of areas."""

Objects: TypeAlias = NDArray[np.float64]
"""Centres and lengths ``[n, 3]`` of objects judged by eye."""

Scores: TypeAlias = NDArray[np.float64]
"""Scores ``[n]``."""

Flags: TypeAlias = NDArray[np.bool_]
"""Which of the boxes ``[n]`` have a property."""

# Largest enlargement of an image, by the length of cars in pixels that it is to have.
_MAX_ENLARGEMENT = {15.0: 1.5, 28.0: 2.2, 55.0: 1.2}
# Least score of the detector alone, and of detector and verifier.
_MIN_DETECTOR_SCORE = 0.12
_MIN_SEARCH_SCORE = 0.1
# Side of the part of an image that is searched as the library does.
_CROP_PX = 640
# False candidates of an image at one size: half the surest ones, half random ones.
_MAX_FALSE = 50
# Set of the candidates that were judged by eye: they are few, and each counts more.
_BY_EYE = "seen"
# Largest distance in lengths, and largest log ratio of lengths, to a car judged by eye.
_MAX_GAP = 0.15
_MAX_LOG_LENGTH = 0.2
# A box fits from this IoU with a label on, and does not fit below the second one.
_FITS = 0.5
_MISSES = 0.25
GSD_M_PER_PX = {"cannes": 0.20, "ucm": 0.3048, "saopaulo": 0.10, "empty": 0.3048}
# Share of the labelled cars that give a box that does not fit.
_MOVED_SHARE = 0.35
_MIN_LENGTH_PX = 8.0
LOOKED_AT = Path(__file__).with_name("looked_at.csv")
_TYPE_OF_BODY = {
    "kei": "kei", "kei truck": "kei", "city": "small", "suv": "suv", "minivan": "van", "van": "van",
    "pickup": "pickup", "single cab": "pickup", "crew cab": "pickup", "flatbed": "pickup",
    "truck": "lorry", "bus": "lorry", "semitrailer": "lorry", "caravan": "trailer",
}  # fmt: skip
_OTHER = KINDS.index("other")
_LORRY = KINDS.index("lorry")


class Seen(NamedTuple):
    """Objects of an image that were judged by eye.

    Attributes:
        squares: ``[n, 4, 2]`` corners around cars without a label and doubtful objects.
        cars: ``[m, 3]`` centres and lengths of the cars.
        others: ``[k, 3]`` centres and lengths of objects that are not cars.
    """

    squares: Polygons = np.zeros((0, 4, 2))
    cars: Objects = np.zeros((0, 3))
    others: Objects = np.zeros((0, 3))


class Named(NamedTuple):
    """Image to mine, and its origin."""

    sample: TrainImage
    file: str
    set: str
    labels: Path | None
    label_types: NDArray[np.int8] | None = None
    seen: Seen = Seen()


def type_of(body: str, length_m: float) -> int:
    """Return the index into ``KINDS`` of a rendered vehicle."""
    kind = _TYPE_OF_BODY.get(body.partition(":")[0])
    if kind is not None:
        return KINDS.index(kind)
    # Hatchbacks, saloons and estates differ by length.
    if length_m < 3.95:
        return KINDS.index("small")
    if length_m < 4.45:
        return KINDS.index("compact")
    return KINDS.index("saloon")


def relative(boxes: Boxes, truth: Boxes) -> NDArray[np.float32]:
    """Compute true boxes relative to candidates, ``[n, 5]``; see ``Rows.box``.

    Args:
        boxes: ``[n, 5]`` candidates.
        truth: ``[n, 5]`` true box of each candidate.
    """
    cos = np.cos(boxes[:, 4])
    sin = np.sin(boxes[:, 4])
    offsets = truth[:, :2] - boxes[:, :2]
    dx, dy = offsets.T / boxes[:, 2]
    turn = (truth[:, 4] - boxes[:, 4] + np.pi / 2) % np.pi - np.pi / 2
    log_sizes = np.log(truth[:, 2:4] / boxes[:, 2:3])
    along = cos * dx + sin * dy
    across = cos * dy - sin * dx
    return np.column_stack([along, across, log_sizes, turn]).astype(np.float32)


def overlaps(boxes: Boxes, labels: Boxes) -> tuple[Scores, NDArray[np.intp]]:
    """Compute the largest IoU of each box with a label, and that label's index, both ``[n]``."""
    if not len(labels):
        return np.zeros(len(boxes)), np.zeros(len(boxes), np.intp)
    iou = oriented_iou(boxes, labels)
    return iou.max(axis=1), iou.argmax(axis=1)


def _ignored(boxes: Boxes, polygons: Polygons) -> Flags:
    """Mark boxes whose centre lies in an ignored polygon, or within 0.3 lengths of it."""
    ignored = np.zeros(len(boxes), bool)
    for polygon in polygons:
        outline = polygon.astype(np.float32)
        # Exact distances are slow, so only boxes near the polygon get one.
        distances = np.linalg.norm(boxes[:, :2] - polygon.mean(axis=0), axis=1)
        near = np.flatnonzero(distances < 3 * boxes[:, 2] + 60)
        for k in near[~ignored[near]]:
            centre = (float(boxes[k, 0]), float(boxes[k, 1]))
            inset = cv2.pointPolygonTest(outline, centre, measureDist=True)
            ignored[k] = inset > -0.3 * boxes[k, 2]
    return ignored


def _fits_by_eye(boxes: Boxes, objects: Objects) -> Flags:
    """Mark boxes that lie on an object judged by eye, ``[k, 3]``, and are about as long."""
    offsets = boxes[:, None, :2] - objects[None, :, :2]
    gap = np.linalg.norm(offsets, axis=2)
    is_near = gap < _MAX_GAP * objects[None, :, 2]
    log_ratio = np.abs(np.log(boxes[:, None, 2] / objects[None, :, 2]))
    fits = is_near & (log_ratio < _MAX_LOG_LENGTH)
    return np.asarray(fits.any(axis=1))


def rows_of(
    image: Named,
    boxes: Boxes,
    scores: Scores,
    combined: Scores,
) -> tuple[Rows, Flags]:
    """Compare boxes with labels and with objects judged by eye.

    Returns:
        A row for each box, and ``[n]`` whether it can train.
    """
    sample = image.sample
    iou, which = overlaps(boxes, sample.boxes)
    car = np.where(iou >= _FITS, 1, 0).astype(np.int8)
    # A box that fits in part, or lies on something doubtful, teaches nothing.
    is_clear = (iou >= _FITS) | (iou < _MISSES)
    is_clear &= (car == 1) | ~_ignored(boxes, sample.ignore)
    box = np.full((len(boxes), 5), np.nan, np.float32)
    length_m = np.full(len(boxes), np.nan, np.float32)
    hit = np.flatnonzero(car == 1)
    if len(hit):
        truth = sample.boxes[which[hit]]
        box[hit] = relative(boxes[hit], truth)
        gsd = CAR_M / sample.car_px if sample.car_px else GSD_M_PER_PX.get(sample.set)
        if gsd:
            length_m[hit] = np.log(truth[:, 2] * gsd)
    is_other = (car == 0) & (iou < 0.01)
    kind = np.where(is_other, _OTHER, UNKNOWN).astype(np.int8)
    if image.label_types is not None:
        kind[hit] = image.label_types[which[hit]]
    cars = (iou < _FITS) & _fits_by_eye(boxes, image.seen.cars)
    others = (iou < _FITS) & _fits_by_eye(boxes, image.seen.others)
    car[cars] = 1
    kind[cars] = UNKNOWN
    is_clear[cars] = True
    rows = Rows.unlabelled(boxes[:, 2], sample.set, image.file)
    rows = rows._replace(
        car=car,
        type=kind,
        box=box,
        log_length_m=length_m,
        sets=np.where(cars | others, _BY_EYE, rows.sets),
        score=scores.astype(np.float32),
        combined=combined.astype(np.float32),
    )
    return rows, is_clear


def detect(sample: TrainImage, detector: Detector, rng: Generator) -> tuple[Boxes, Scores, Scores]:
    """Search an image at one or two sizes.

    Returns:
        Boxes in image pixels, the detector's scores, and those of the verifier.
    """
    car_px = sample.car_px or 18.0
    if len(sample.boxes):
        car_px = float(np.median(sample.boxes[:, 2]))
    boxes = [np.zeros((0, 5))]
    scores = [np.zeros(0)]
    combined = [np.zeros(0)]
    target_lengths_px = [28.0]
    if max(sample.image.shape) <= 1300:
        target_lengths_px.append(float(rng.choice((15.0, 55.0))))
    for target_px in target_lengths_px:
        factor = target_px / car_px
        shorter_px = min(sample.image.shape[:2]) * factor
        if factor > _MAX_ENLARGEMENT[target_px] or shorter_px < 48:
            continue
        method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        resized = cv2.resize(sample.image, None, fx=factor, fy=factor, interpolation=method)
        scaled = np.asarray(resized, np.uint8)
        tile = detector.prepared(scaled)
        vehicles = detector.detect_tile(tile, _MIN_DETECTOR_SCORE).vehicles
        vehicles = vehicles.take(oriented_nms(vehicles.boxes, vehicles.scores))
        if not len(vehicles):
            continue
        assert detector.verifier is not None
        boxes.append(vehicles.boxes / (factor, factor, factor, factor, 1))
        scores.append(vehicles.scores)
        verified = detector.verifier.scored(scaled, vehicles)
        combined.append(verified.scores)
    return np.concatenate(boxes), np.concatenate(scores), np.concatenate(combined)


def cropped(rng: Generator, sample: TrainImage, side_px: int = _CROP_PX) -> TrainImage:
    """Cut a part of a large image, if possible around a labelled car; cars it cuts are ignored."""
    height, width = sample.image.shape[:2]
    if max(height, width) <= side_px:
        return sample
    farthest = np.maximum(np.array([width, height]) - side_px, 0)
    if len(sample.boxes):
        middle = sample.boxes[rng.integers(len(sample.boxes)), :2]
    else:
        middle = rng.uniform(0, 1, 2) * farthest
    corner = middle - rng.uniform(0.2, 0.8, 2) * side_px
    left, top = np.clip(corner, 0, farthest).astype(int)
    rows = slice(top, top + side_px)
    columns = slice(left, left + side_px)
    image = np.ascontiguousarray(sample.image[rows, columns])
    boxes = sample.boxes - (left, top, 0, 0, 0)
    corners = box_corners(boxes)
    size = np.array(image.shape[1::-1])
    inside = np.all((corners >= 0) & (corners <= size), axis=2)
    whole = np.all(inside, axis=1)
    cut = np.any(inside, axis=1) & ~whole
    ignore = np.concatenate([sample.ignore - (left, top), corners[cut]])
    return sample._replace(image=image, boxes=boxes[whole], ignore=ignore)


def search(sample: TrainImage, detector: Detector) -> tuple[Boxes, Scores, Scores]:
    """Search an image as the library does: boxes, scores, and the same scores again."""
    with open_raster(sample.image) as raster:
        options = Search(min_score=_MIN_SEARCH_SCORE)
        vehicles = ImageSearch(raster, detector, options).searched()
    return vehicles.boxes, vehicles.scores, vehicles.scores


def moved(rng: Generator, labels: Boxes) -> Boxes:
    """Move boxes until they no longer fit: beside a car, half or twice as long, or across it."""
    out = labels[rng.random(len(labels)) < _MOVED_SHARE].copy()
    for box in out:
        how = rng.integers(3)
        if how == 0:
            angle = rng.uniform(0, 2 * np.pi)
            reach = rng.uniform(0.4, 1.0) * box[2]
            box[:2] += reach * np.array([np.cos(angle), np.sin(angle)])
        elif how == 1:
            log_factor = rng.choice((-1, 1)) * rng.uniform(0.4, 0.9)
            box[2:4] *= np.exp(log_factor)
            box[:2] += rng.normal(0, 0.12 * box[2], 2)
        else:
            box[4] += rng.uniform(0.6, np.pi - 0.6)
    return out


def add_lorries(image: Named, store: ChipStore) -> None:
    """Add labelled lorries; of upright boxes only those clearly longer one way."""
    if image.labels is None:
        return
    corners = read_labels(image.labels, []).of_class("large-vehicle")
    boxes = boxes_from_corners(corners) if len(corners) else np.zeros((0, 5))
    lengths = boxes[:, 2]
    is_longish = lengths > 1.7 * boxes[:, 3]
    boxes = boxes[is_longish & (lengths > 1.5 * _MIN_LENGTH_PX)]
    if not len(boxes):
        return
    rows = Rows.unlabelled(boxes[:, 2], f"lorry_{image.set}", image.file)
    rows = rows._replace(type=np.full(len(boxes), _LORRY, np.int8))
    store.add(
        surroundings(image.sample.image, boxes, side_px=STORED_PX, length_px=STORED_LENGTH_PX), rows
    )


def mined(
    image: Named, detector: Detector, rng: Generator, store: ChipStore, *, native: bool
) -> None:
    """Add the chips of one image.

    A native search gives detections. Another one also gives labels, moved labels and lorries.
    """
    sample = image.sample
    if native and image.set != "chia":
        sample = cropped(rng, image.sample)
    if sample is not image.sample:
        # A part has other coordinates than the objects judged by eye.
        image = image._replace(sample=sample, seen=Seen())
    height, width = sample.image.shape[:2]
    if native:
        boxes, scores, combined = search(sample, detector)
        labels = np.zeros((0, 5))
    else:
        add_lorries(image, store)
        boxes, scores, combined = detect(sample, detector, rng)
        labels = np.concatenate([sample.boxes, moved(rng, sample.boxes)])
    boxes = np.concatenate([boxes, labels])
    scores = np.concatenate([scores, np.zeros(len(labels))])
    combined = np.concatenate([combined, np.zeros(len(labels))])
    centres = boxes[:, :2]
    inside = ((centres > 0) & (centres < (width, height))).all(axis=1)
    inside &= boxes[:, 2] >= _MIN_LENGTH_PX
    boxes = boxes[inside]
    scores = scores[inside]
    combined = combined[inside]
    if not len(boxes):
        return
    rows, can_train = rows_of(image, boxes, scores, combined)
    # Of many false candidates, the surest and some random ones are kept.
    false = np.flatnonzero(can_train & (rows.car == 0) & (scores > 0))
    false = false[np.argsort(-combined[false], kind="stable")]
    others = rng.permutation(false[_MAX_FALSE // 2 :])
    can_train[others[_MAX_FALSE // 2 :]] = False
    chips = surroundings(
        sample.image, boxes[can_train], side_px=STORED_PX, length_px=STORED_LENGTH_PX
    )
    store.add(chips, rows.take(can_train))


def _seen_by_eye() -> dict[str, Seen]:
    """Read ``looked_at.csv``, by the name of the image."""
    rows: dict[str, list[dict[str, str]]] = {}
    with LOOKED_AT.open(newline="") as handle:
        for row in csv.DictReader(handle):
            rows.setdefault(row["file"], []).append(row)
    seen = {}
    for file, of_file in rows.items():
        names = ("x", "y", "length")
        objects = np.array([[float(row[name]) for name in names] for row in of_file])
        is_car = np.array([row["kind"] == "car" for row in of_file])
        is_other = np.array([row["kind"] == "other" for row in of_file])
        boxes = np.column_stack([objects, objects[:, 2], np.zeros(len(objects))])
        squares = box_corners(boxes)
        seen[file] = Seen(squares[~is_other], cars=objects[is_car], others=objects[is_other])
    return seen


def train_images(data: Path, *, held_out: bool) -> Iterator[Named]:
    """Load the labelled train images and the scenery, or their held-out tenth."""
    by_file = _seen_by_eye()

    def named(sample: TrainImage, path: Path, set_name: str, labels: Path | None) -> Named:
        seen = by_file.get(path.name, Seen())
        sample = sample._replace(ignore=np.concatenate([sample.ignore, seen.squares]))
        return Named(sample, path.name, set=set_name, labels=labels, seen=seen)

    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "train"]
    rows = [row for row in rows if is_dev(row["file"], row["set"]) == held_out]
    samples = load_train_images(data / "vehicles", held_out=held_out)
    for sample, row in zip(samples, rows, strict=True):
        path = Path(row["file"])
        labels = data / "vehicles" / "labels" / f"{path.stem}.txt"
        yield named(sample, path, row["set"], labels)
    scenery = [place for place in places(data) if is_held_out(place) == held_out]
    for sample, place in zip(load_scenery(data, held_out=held_out), scenery, strict=True):
        yield named(sample, place.path, place.set, place.labels)


def chia_images(data: Path) -> Iterator[Named]:
    """Load the crops of ``chia/`` with odd numbers, at 0.018 to 0.043 m/px, and their cars."""
    by_file = _seen_by_eye()
    with (data / "chia" / "crops.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if _number(row["file"]) % 2 == 1]
    for row in rows:
        path = data / "chia" / row["file"]
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(path)
        seen = by_file.get(path.name, Seen())
        sample = TrainImage(
            "chia",
            np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8),
            boxes=np.zeros((0, 5)),
            ignore=seen.squares,
            clutter=np.zeros((0, 2)),
            car_px=CAR_M / float(row["gsd_m_per_px"]),
        )
        yield Named(sample, path.name, set="chia", labels=None, seen=seen)


def _number(file: str) -> int:
    """Read the number at the end of a file's name."""
    return int(Path(file).stem[-4:])


def scene_images(folder: Path) -> Iterator[Named]:
    """Load rendered scenes with the types of their vehicles (``render_scenes chips``)."""
    for path, sample in zip(sorted(folder.glob("*.jpg")), load_scenes(folder), strict=True):
        labels = read_labels(path.with_suffix(".txt"))
        assert labels.gsd_m_per_px is not None
        bodies_text = path.with_suffix(".bodies.json").read_text()
        bodies = np.array(json.loads(bodies_text), dtype=object)
        is_small = np.array(labels.classes) == "small-vehicle"
        counted = is_small & ~labels.difficult
        lengths_m = sample.boxes[:, 2] * labels.gsd_m_per_px
        types = [
            type_of(body, length) for body, length in zip(bodies[counted], lengths_m, strict=True)
        ]
        sized = sample._replace(car_px=CAR_M / labels.gsd_m_per_px)
        yield Named(
            sized,
            path.name,
            set="scene",
            labels=path.with_suffix(".txt"),
            label_types=np.array(types, np.int8),
        )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--scenes", type=Path, help="mine only a folder of `render_scenes chips`, into RUN/rendered"
    )
    parser.add_argument(
        "--native", action="store_true", help="search as the library does, into RUN/native"
    )
    parser.add_argument("--sets", default="", help="with --native: only these, separated by commas")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    parts: dict[str, Iterator[Named]]
    if options.native:
        scenes = scene_images(options.scenes) if options.scenes else iter(())
        sets = [name for name in options.sets.split(",") if name]
        every = itertools.chain(
            train_images(options.data, held_out=False), chia_images(options.data), scenes
        )
        parts = {"native": (image for image in every if not sets or image.sample.set in sets)}
    elif options.scenes:
        parts = {"rendered": scene_images(options.scenes)}
    else:
        parts = {
            "held_out": train_images(options.data, held_out=True),
            "train": train_images(options.data, held_out=False),
        }
    detector = Detector(resolve_model(), runtime=Runtime(threads=1))
    # The chip network would drop candidates that it has to learn from.
    detector.chips = None
    for name, images in parts.items():
        store = ChipStore()
        rng = np.random.default_rng(0)
        for number, image in enumerate(images):
            mined(image, detector, rng, store, native=options.native)
            if number % 50 == 0:
                print(name, number, sum(map(len, store.chips)), flush=True)
        rows = store.save(options.run / name)
        for set_name in np.unique(rows.sets):
            cars = rows.car[rows.sets == set_name] == 1
            print(f"{name} {set_name}: {cars.sum()} cars, {(~cars).sum()} others", flush=True)


if __name__ == "__main__":
    main()
