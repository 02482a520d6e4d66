"""Collect candidates from the train images: ``python -m research.training.chips.mine RUN``.

Writes the stores ``RUN/train`` and ``RUN/held_out``. A chip comes from one of four sources: what
the bundled detector finds at a low score, every labelled car, labelled boxes moved or scaled until
they fit no more, and lorries. Cars without a label that ``looked_at.csv`` has are cars, and nothing
on something doubtful is a false one; of the odd numbers of ``chia/crops``, which ``--native`` adds,
it has all of them.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
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

_CAR_PX = (28.0, 15.0, 55.0)  # lengths of cars at which an image is searched
_MAX_ENLARGEMENT = {15.0: 1.5, 28.0: 2.2, 55.0: 1.2}
_LEAST_SCORE = 0.12  # of the detector alone
_LEAST_SEARCHED = 0.1  # of the verifier
_CROP_PX = 640  # side of the part of an image that is searched as the library does
_MOST_FALSE = 50  # of an image at one size: half the surest, half at random
_SEEN = "seen"  # set of candidates that an eye has judged: they are few, and each counts more
# of a candidate that is a car seen without a label
_SEEN_GAP = 0.15
_SEEN_LOG_LENGTH = 0.2
# IoU with a label from which a box fits, and below which it does not
_FITS = 0.5
_MISSES = 0.25
GSD_M_PER_PX = {"cannes": 0.20, "ucm": 0.3048, "saopaulo": 0.10, "empty": 0.3048}
_MOVED_SHARE = 0.35  # of the labelled cars give a box that does not fit
_LEAST_LENGTH_PX = 8.0
LOOKED_AT = Path(__file__).with_name("looked_at.csv")
_TYPE_OF_BODY = {
    "kei": "kei", "kei truck": "kei", "city": "small", "suv": "suv", "minivan": "van", "van": "van",
    "pickup": "pickup", "single " "cab": "pickup", "crew " "cab": "pickup", "flatbed": "pickup",
    "truck": "lorry", "bus": "lorry", "semitrailer": "lorry", "caravan": "trailer",
}  # fmt: skip
_OTHER = KINDS.index("other")
_LORRY = KINDS.index("lorry")


class Seen(NamedTuple):
    """What was judged by eye on an image.

    Attributes:
        squares: ``[n, 4, 2]`` corners around cars without a label and doubtful things.
        cars: ``[m, 3]`` centres and lengths of the cars.
        others: ``[k, 3]`` of what is no car.
    """

    squares: NDArray[np.float64] = np.zeros((0, 4, 2))
    cars: NDArray[np.float64] = np.zeros((0, 3))
    others: NDArray[np.float64] = np.zeros((0, 3))


class Named(NamedTuple):
    """An image to mine, and where it comes from."""

    sample: TrainImage
    file: str
    set: str
    labels: Path | None
    label_types: NDArray[np.int8] | None = None
    seen: Seen = Seen()


def type_of(body: str, length_m: float) -> int:
    """Index into ``KINDS`` of a rendered vehicle; hatchbacks, saloons and estates by their length."""
    known = _TYPE_OF_BODY.get(body.partition(":")[0])
    if known is None:
        known = "small" if length_m < 3.95 else "compact" if length_m < 4.45 else "saloon"
    return KINDS.index(known)


def relative(boxes: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float32]:
    """True boxes relative to candidates, ``[n, 5]``; see ``Rows.box``.

    Args:
        boxes: ``[n, 5]`` candidates.
        truth: ``[n, 5]`` the true box of each.
    """
    cos = np.cos(boxes[:, 4])
    sin = np.sin(boxes[:, 4])
    dx, dy = (truth[:, :2] - boxes[:, :2]).T / boxes[:, 2]
    turn = (truth[:, 4] - boxes[:, 4] + np.pi / 2) % np.pi - np.pi / 2
    sizes = np.log(truth[:, 2:4] / boxes[:, 2:3])
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, sizes, turn]).astype(
        np.float32
    )


def overlaps(
    boxes: NDArray[np.float64], labels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Largest IoU of each box with a label, and which label ``[n]``; 0 and 0 where none is near."""
    if not len(labels):
        return np.zeros(len(boxes)), np.zeros(len(boxes), np.intp)
    iou = oriented_iou(boxes, labels)
    return iou.max(axis=1), iou.argmax(axis=1)


def _ignored(boxes: NDArray[np.float64], polygons: NDArray[np.float64]) -> NDArray[np.bool_]:
    out = np.zeros(len(boxes), bool)
    for polygon in polygons:
        around = polygon.astype(np.float32)
        close = np.flatnonzero(
            np.linalg.norm(boxes[:, :2] - polygon.mean(axis=0), axis=1) < 3 * boxes[:, 2] + 60
        )
        for k in close[~out[close]]:
            reach = cv2.pointPolygonTest(
                around, (float(boxes[k, 0]), float(boxes[k, 1])), measureDist=True
            )
            out[k] = reach > -0.3 * boxes[k, 2]
    return out


def _fits_seen(boxes: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.bool_]:
    gap = np.linalg.norm(boxes[:, None, :2] - seen[None, :, :2], axis=2)
    alike = np.abs(np.log(boxes[:, None, 2] / seen[None, :, 2])) < _SEEN_LOG_LENGTH
    return np.asarray(((gap < _SEEN_GAP * seen[None, :, 2]) & alike).any(axis=1))


def rows_of(
    image: Named,
    boxes: NDArray[np.float64],
    scores: NDArray[np.float64],
    combined: NDArray[np.float64],
) -> tuple[Rows, NDArray[np.bool_]]:
    """Compare boxes with labels and with cars seen without one; also return which boxes can train."""
    sample = image.sample
    iou, which = overlaps(boxes, sample.boxes)
    car = np.where(iou >= _FITS, 1, 0).astype(np.int8)
    known = (iou >= _FITS) | (iou < _MISSES)
    known &= (car == 1) | ~_ignored(boxes, sample.ignore)
    box = np.full((len(boxes), 5), np.nan, np.float32)
    length_m = np.full(len(boxes), np.nan, np.float32)
    hit = np.flatnonzero(car == 1)
    if len(hit):
        truth = sample.boxes[which[hit]]
        box[hit] = relative(boxes[hit], truth)
        gsd = CAR_M / sample.car_px if sample.car_px else GSD_M_PER_PX.get(sample.set)
        if gsd:
            length_m[hit] = np.log(truth[:, 2] * gsd)
    kind = np.where((car == 0) & (iou < 0.01), _OTHER, UNKNOWN).astype(np.int8)
    if image.label_types is not None:
        kind[hit] = image.label_types[which[hit]]
    cars, others = (
        (iou < _FITS) & _fits_seen(boxes, each) for each in (image.seen.cars, image.seen.others)
    )
    car[cars] = 1
    kind[cars] = UNKNOWN
    known[cars] = True
    rows = Rows.unlabelled(boxes[:, 2], sample.set, image.file)
    rows = rows._replace(car=car, type=kind, box=box, log_length_m=length_m)
    rows = rows._replace(sets=np.where(cars | others, _SEEN, rows.sets))
    return rows._replace(
        score=scores.astype(np.float32), combined=combined.astype(np.float32)
    ), known


def found(
    sample: TrainImage, detector: Detector, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Boxes in image pixels, the detector's scores, and those of the verifier, searched at one or two sizes."""
    native = float(np.median(sample.boxes[:, 2])) if len(sample.boxes) else sample.car_px or 18.0
    boxes = [np.zeros((0, 5))]
    scores = [np.zeros(0)]
    combined = [np.zeros(0)]
    sizes = [28.0, float(rng.choice((15.0, 55.0)))] if max(sample.image.shape) <= 1300 else [28.0]
    for target in sizes:
        factor = target / native
        if factor > _MAX_ENLARGEMENT[target] or min(sample.image.shape[:2]) * factor < 48:
            continue
        way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
        scaled = np.asarray(
            cv2.resize(sample.image, None, fx=factor, fy=factor, interpolation=way), np.uint8
        )
        seen = detector.detect_tile(detector.prepared(scaled), _LEAST_SCORE).vehicles
        seen = seen.take(oriented_nms(seen.boxes, seen.scores))
        if not len(seen):
            continue
        assert detector.verifier is not None
        boxes.append(seen.boxes / (factor, factor, factor, factor, 1))
        scores.append(seen.scores)
        combined.append(detector.verifier.scored(scaled, seen).scores)
    return np.concatenate(boxes), np.concatenate(scores), np.concatenate(combined)


def cropped(rng: np.random.Generator, sample: TrainImage, side_px: int = _CROP_PX) -> TrainImage:
    """A part of a large image, around a labelled car where there is one; cars that it cuts are ignored."""
    height, width = sample.image.shape[:2]
    if max(height, width) <= side_px:
        return sample
    most = np.maximum(np.array([width, height]) - side_px, 0)
    middle = (
        sample.boxes[rng.integers(len(sample.boxes)), :2]
        if len(sample.boxes)
        else rng.uniform(0, 1, 2) * most
    )
    left, top = np.clip(middle - rng.uniform(0.2, 0.8, 2) * side_px, 0, most).astype(int)
    image = np.ascontiguousarray(sample.image[top : top + side_px, left : left + side_px])
    boxes = sample.boxes - (left, top, 0, 0, 0)
    corners = box_corners(boxes)
    inside = np.all((corners >= 0) & (corners <= np.array(image.shape[1::-1])), axis=2)
    whole = np.all(inside, axis=1)
    cut = np.any(inside, axis=1) & ~whole
    ignore = np.concatenate([sample.ignore - (left, top), corners[cut]])
    return sample._replace(image=image, boxes=boxes[whole], ignore=ignore)


def searched(
    sample: TrainImage, detector: Detector
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Boxes and scores as the library's search finds them, at the image's own and coarser resolutions."""
    with open_raster(sample.image) as raster:
        seen = ImageSearch(raster, detector, Search(min_score=_LEAST_SEARCHED)).searched()
    return seen.boxes, seen.scores, seen.scores


def moved(rng: np.random.Generator, labels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Boxes that fit no more: beside a car, half or twice as long, or across it."""
    out = labels[rng.random(len(labels)) < _MOVED_SHARE].copy()
    for box in out:
        how = rng.integers(3)
        if how == 0:
            angle = rng.uniform(0, 2 * np.pi)
            reach = rng.uniform(0.4, 1.0) * box[2]
            box[:2] += reach * np.array([np.cos(angle), np.sin(angle)])
        elif how == 1:
            box[2:4] *= np.exp(rng.choice((-1, 1)) * rng.uniform(0.4, 0.9))
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
    boxes = boxes[(boxes[:, 2] > 1.7 * boxes[:, 3]) & (boxes[:, 2] > 1.5 * _LEAST_LENGTH_PX)]
    if not len(boxes):
        return
    rows = Rows.unlabelled(boxes[:, 2], f"lorry_{image.set}", image.file)
    rows = rows._replace(type=np.full(len(boxes), _LORRY, np.int8))
    store.add(
        surroundings(image.sample.image, boxes, side_px=STORED_PX, length_px=STORED_LENGTH_PX), rows
    )


def mined(
    image: Named, detector: Detector, rng: np.random.Generator, store: ChipStore, *, native: bool
) -> None:
    """Add the chips of one image: of a native search what it finds, else also labels, moved labels and lorries."""
    sample = cropped(rng, image.sample) if native and image.set != "chia" else image.sample
    if sample is not image.sample:
        image = image._replace(sample=sample, seen=Seen())  # a part has other coordinates
    height, width = sample.image.shape[:2]
    if native:
        boxes, scores, combined = searched(sample, detector)
        extra = np.zeros((0, 5))
    else:
        add_lorries(image, store)
        boxes, scores, combined = found(sample, detector, rng)
        extra = np.concatenate([sample.boxes, moved(rng, sample.boxes)])
    boxes = np.concatenate([boxes, extra])
    scores, combined = (np.concatenate([each, np.zeros(len(extra))]) for each in (scores, combined))
    inside = (boxes[:, :2] > 0).all(axis=1) & (boxes[:, 0] < width) & (boxes[:, 1] < height)
    inside &= boxes[:, 2] >= _LEAST_LENGTH_PX
    boxes = boxes[inside]
    scores = scores[inside]
    combined = combined[inside]
    if not len(boxes):
        return
    rows, known = rows_of(image, boxes, scores, combined)
    false = np.flatnonzero(known & (rows.car == 0) & (scores > 0))
    false = false[np.argsort(-combined[false], kind="stable")]
    rest = rng.permutation(false[_MOST_FALSE // 2 :])
    known[rest[_MOST_FALSE // 2 :]] = False
    store.add(
        surroundings(sample.image, boxes[known], side_px=STORED_PX, length_px=STORED_LENGTH_PX),
        rows.take(known),
    )


def _seen_by_eye() -> dict[str, Seen]:
    """Read ``looked_at.csv``, by the name of the image."""
    rows: dict[str, list[dict[str, str]]] = {}
    with LOOKED_AT.open(newline="") as handle:
        for row in csv.DictReader(handle):
            rows.setdefault(row["file"], []).append(row)
    out = {}
    for file, each in rows.items():
        at = np.array([[float(row[name]) for name in ("x", "y", "length")] for row in each])
        cars, others = (
            np.array([row["kind"] == kind for row in each]) for kind in ("car", "other")
        )
        squares = box_corners(np.column_stack([at, at[:, 2], np.zeros(len(at))]))
        out[file] = Seen(squares[~others], at[cars], at[others])
    return out


def train_images(data: Path, *, held_out: bool) -> Iterator[Named]:
    """The labelled train images and the scenery, or their held-out tenth."""
    by_file = _seen_by_eye()

    def named(sample: TrainImage, path: Path, set_name: str, labels: Path | None) -> Named:
        seen = by_file.get(path.name, Seen())
        sample = sample._replace(ignore=np.concatenate([sample.ignore, seen.squares]))
        return Named(sample, path.name, set=set_name, labels=labels, seen=seen)

    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "train"]
    rows = [row for row in rows if is_dev(row["file"], row["set"]) == held_out]
    for sample, row in zip(
        load_train_images(data / "vehicles", held_out=held_out), rows, strict=True
    ):
        path = Path(row["file"])
        yield named(sample, path, row["set"], data / "vehicles" / "labels" / f"{path.stem}.txt")
    chosen = [place for place in places(data) if is_held_out(place) == held_out]
    for sample, place in zip(load_scenery(data, held_out=held_out), chosen, strict=True):
        yield named(sample, place.path, place.set, place.labels)


def chia_images(data: Path) -> Iterator[Named]:
    """Crops of ``chia/`` with odd numbers, at 0.018 to 0.043 m/px, with the cars that were seen."""
    by_file = _seen_by_eye()
    with (data / "chia" / "crops.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if int(Path(row["file"]).stem[-4:]) % 2 == 1]
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


def scene_images(folder: Path) -> Iterator[Named]:
    """Rendered scenes with the types of their vehicles (``render_scenes chips``)."""
    for path, sample in zip(sorted(folder.glob("*.jpg")), load_scenes(folder), strict=True):
        labels = read_labels(path.with_suffix(".txt"))
        assert labels.gsd_m_per_px is not None
        bodies = np.array(json.loads(path.with_suffix(".bodies.json").read_text()), dtype=object)
        counted = (np.array(labels.classes) == "small-vehicle") & ~labels.difficult
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
        "--scenes", type=Path, help="a folder of `render_scenes chips` alone, into RUN/rendered"
    )
    parser.add_argument(
        "--native", action="store_true", help="search as the library does, into RUN/native"
    )
    parser.add_argument("--sets", default="", help="with --native: these alone, comma between")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    parts: dict[str, Iterator[Named]]
    if options.native:
        scenes = scene_images(options.scenes) if options.scenes else iter(())
        wanted = [name for name in options.sets.split(",") if name]
        every = itertools.chain(
            train_images(options.data, held_out=False), chia_images(options.data), scenes
        )
        parts = {"native": (image for image in every if not wanted or image.sample.set in wanted)}
    elif options.scenes:
        parts = {"rendered": scene_images(options.scenes)}
    else:
        parts = {
            name: train_images(options.data, held_out=name == "held_out")
            for name in ("held_out", "train")
        }
    detector = Detector(resolve_model(), runtime=Runtime(threads=1))
    detector.chips = None  # its candidates are wanted
    for name, images in parts.items():
        store = ChipStore()
        rng = np.random.default_rng(0)
        for number, image in enumerate(images):
            mined(image, detector, rng, store, native=options.native)
            if number % 50 == 0:
                print(name, number, sum(map(len, store.chips)), flush=True)
        rows = store.save(options.run / name)
        for each in np.unique(rows.sets):
            cars = rows.car[rows.sets == each] == 1
            print(f"{name} {each}: {cars.sum()} cars, {(~cars).sum()} others", flush=True)


if __name__ == "__main__":
    main()
