"""Count true and false cars by place.

``python -m research.benchmarks.regression_sets [--detector FILE]``.

Prints Markdown; ``--record`` keeps it. ``--part`` chooses:

* ``people``: precision and recall on upright boxes drawn by people. A hit has its centre inside the
  label grown by a tenth and a length between 0.6 of the label's longer side and 1.25 of its
  diagonal; each label is hit once, and a second hit is a false box. Boxes on labelled lorries count
  as false, too. "Corrected by eye" adds cars that nobody had labelled and leaves doubtful things
  out (``training/chips/looked_at.csv``);
* ``clutter``: false boxes a megapixel where there are no cars, or where the cars are known;
* ``mistakes``: confidence of 0.5 and more on an image of known scale with an error above 20 %, or
  without cars.

``--held-out`` measures ``people`` on the held-out tenth of *train* instead of *val*: thresholds are
chosen there. ``--thresholds`` prints a row for each of several scores instead of the model's own
alone. A detector without its verifier and its chip network is a copy of its file in another folder.
"""

from __future__ import annotations

import argparse
import csv
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from research.results.record import add_record_option, recording
from research.training import chips
from research.training.detector.places import Place, is_held_out, looked_at, places
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import ImageSearch
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search
from vehanchor_evaluation.dota import read_labels
from vehanchor_evaluation.table import survey_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    Boxes: TypeAlias = NDArray[np.float64]
    """Boxes ``[n, 5]``: x, y, length, width, angle."""

    Polygons: TypeAlias = NDArray[np.float64]
    """Corners ``[n, 4, 2]`` of areas."""

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]``."""

    Scores: TypeAlias = NDArray[np.float64]
    """Scores ``[n]``."""

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_MIN_SCORE = 0.15
_THRESHOLDS = (0.2, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8)
_LOOKED_AT = Path(chips.__file__).with_name("looked_at.csv")
# Largest distance of a box to a doubtful object, in its lengths, at which it is on the object.
_SAME_PLACE = 0.35
_HIGH_ERROR = 0.2
# A box within this distance of a known car is not false.
_NEAR_CAR_M = 3.0
_PARTS = ("people", "clutter", "mistakes")


class Sighted(NamedTuple):
    """Image with the detector's boxes at a low threshold, and the known cars.

    Attributes:
        boxes: ``[n, 5]`` in image pixels, best first.
        scores: ``[n]``.
        megapixels: size of the image.
        labels: ``[m, 4, 2]`` corners of the boxes of cars that people drew.
        spared: ``[k, 2]`` centres of cars without a label; boxes near them are not false.
        spared_px: largest distance to them.
    """

    boxes: Boxes
    scores: Scores
    megapixels: float
    labels: Polygons = np.zeros((0, 4, 2))
    spared: Points = np.zeros((0, 2))
    spared_px: float = 0.0

    def above(self, min_score: float) -> Sighted:
        """Keep the boxes of at least this score."""
        is_kept = self.scores >= min_score
        return self._replace(boxes=self.boxes[is_kept], scores=self.scores[is_kept])


def hit_labels(boxes: Boxes, labels: Polygons) -> NDArray[np.intp]:
    """Find the upright label that each box hits, -1 for none.

    Args:
        boxes: ``[n, 5]``, best first.
        labels: ``[m, 4, 2]`` corners.
    """
    low = labels.min(axis=1)
    high = labels.max(axis=1)
    side = high - low
    middle = (low + high) / 2
    is_free = np.ones(len(labels), bool)
    hits = np.full(len(boxes), -1, np.intp)
    # The best box takes the nearest label, which no other box can hit then.
    for k, box in enumerate(boxes):
        is_inside = (np.abs(middle - box[:2]) <= 0.55 * side).all(axis=1)
        is_long_enough = box[2] >= 0.6 * side.max(axis=1)
        is_short_enough = box[2] <= 1.25 * np.hypot(*side.T)
        candidates = np.flatnonzero(is_inside & is_long_enough & is_short_enough & is_free)
        if len(candidates):
            distances = np.linalg.norm(middle[candidates] - box[:2], axis=1)
            nearest = candidates[distances.argmin()]
            hits[k] = nearest
            is_free[nearest] = False
    return hits


def precision_recall(images: Iterable[Sighted]) -> tuple[float, float, int, int]:
    """Compute precision, recall, boxes and labels of all images together; 0 of 0 is 1."""
    n_boxes = 0
    n_labels = 0
    n_hits = 0
    for image in images:
        n_hits += int((hit_labels(image.boxes, image.labels) >= 0).sum())
        n_boxes += len(image.boxes)
        n_labels += len(image.labels)
    precision = n_hits / n_boxes if n_boxes else 1.0
    recall = n_hits / n_labels if n_labels else 1.0
    return precision, recall, n_boxes, n_labels


def false_boxes(image: Sighted) -> int:
    """Count the boxes that are neither on a label nor near a known car."""
    wrong = hit_labels(image.boxes, image.labels) < 0
    if len(image.spared):
        offsets = image.boxes[:, None, :2] - image.spared[None]
        gap = np.linalg.norm(offsets, axis=2)
        wrong &= ~(gap < image.spared_px).any(axis=1)
    return int(wrong.sum())


# --- Images


def sighted(image: Path | NDArray[np.uint8], detector: Detector) -> Sighted:
    """Search an image with the default options, at a low threshold."""
    scene_scale = load_scene_scale()
    with open_raster(image) as raster:
        prior = scene_scale.predict(raster)
        search = ImageSearch(raster, detector, Search(min_score=_MIN_SCORE), prior=prior)
        vehicles = search.searched()
        megapixels = raster.width_px * raster.height_px / 1e6
        return Sighted(vehicles.boxes, vehicles.scores, megapixels)


def people_images(data: Path, held_out: bool) -> Iterator[tuple[str, Path, Path]]:
    """List set, image and labels of people's upright boxes."""
    if held_out:
        for place in places(data):
            if place.set == "estonia" and place.labels and is_held_out(place):
                yield "estonia, held-out tenth of train", place.path, place.labels
        return
    with (data / "upright" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "val":
                path = data / "upright" / row["file"]
                yield f"{row['set']}, val", path, data / "upright" / "labels" / f"{path.stem}.txt"


def with_known_cars(place: Place, detector: Detector) -> Sighted:
    """Search an unlabelled place; cars known from contact sheets are excused."""
    candidates = looked_at().get(place.path.name, [])
    cars = [(x, y) for x, y, kind in candidates if kind in ("car", "ignore")]
    return sighted(place.path, detector)._replace(
        spared=np.array(cars).reshape(-1, 2), spared_px=_NEAR_CAR_M / place.gsd_m_per_px
    )


def clutter_sets(data: Path, detector: Detector) -> Iterator[tuple[str, list[Sighted]]]:
    """Search the sets without cars, or with known ones."""
    all_places = places(data)
    held_out = [place for place in all_places if is_held_out(place)]
    quays = [place for place in held_out if place.set == "estonia_port"]
    yield "quays (held-out tenth)", [with_known_cars(place, detector) for place in quays]
    harbours = [place for place in held_out if place.kind == "harbor"]
    yield "harbours (held-out tenth)", [with_known_cars(place, detector) for place in harbours]
    empty = [
        item.path
        for item in survey_table(data / "gsd" / "table.csv").images
        if item.set == "empty" and item.split == "val"
    ]
    yield "empty, val", [sighted(path, detector) for path in empty]
    trained = {place.path for place in all_places}
    photographs = sorted((data / "flights" / "seneca").iterdir())
    fields = [path for path in photographs if path.suffix == ".jpg" and path not in trained]
    yield "fields (seneca, photographs not in train)", [sighted(path, detector) for path in fields]


def corrected(image: Sighted, file: str) -> Sighted:
    """Add the cars seen on contact sheets to the labels; leave out boxes on doubtful objects."""
    with _LOOKED_AT.open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["file"] == file]
    if not rows:
        return image
    names = ("x", "y", "length")
    objects = np.array([[float(row[name]) for name in names] for row in rows])
    cars = objects[[row["kind"] == "car" for row in rows]]
    doubtful = objects[[row["kind"] == "doubtful" for row in rows]]
    corner = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    squares = cars[:, None, :2] + corner * cars[:, None, 2:]
    offsets = image.boxes[:, None, :2] - doubtful[None, :, :2]
    gap = np.linalg.norm(offsets, axis=2)
    is_doubtful = (gap < _SAME_PLACE * doubtful[:, 2]).any(axis=1)
    counts = (hit_labels(image.boxes, image.labels) >= 0) | ~is_doubtful
    return image._replace(
        boxes=image.boxes[counts],
        scores=image.scores[counts],
        labels=np.concatenate([image.labels, squares]),
    )


# --- The tables


def people_sets(data: Path, detector: Detector, held_out: bool) -> dict[str, list[Sighted]]:
    """Search the images with people's boxes, by set."""
    by_set: dict[str, list[Sighted]] = {}
    for name, path, label_file in people_images(data, held_out):
        labels = read_labels(label_file).of_class("small-vehicle")
        image = sighted(path, detector)._replace(labels=labels)
        by_set.setdefault(name, []).append(image)
        if name == "estonia, val":
            by_set.setdefault(f"{name}, corrected by eye", []).append(corrected(image, path.name))
    return by_set


def people_report(by_set: Mapping[str, list[Sighted]], thresholds: list[float]) -> list[str]:
    """Tabulate precision and recall by set and threshold."""
    lines = [
        "| labelled boxes | score | images | labels | boxes | precision | recall |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, images in by_set.items():
        for score in thresholds:
            precision, recall, n_boxes, n_labels = precision_recall(
                image.above(score) for image in images
            )
            lines.append(
                f"| {name} | {score:g} | {len(images)} | {n_labels} | {n_boxes} | "
                f"{precision:.3f} | {recall:.3f} |"
            )
    return lines


def clutter_report(data: Path, detector: Detector, thresholds: list[float]) -> list[str]:
    """Tabulate false boxes a megapixel by set and threshold."""
    lines = [
        "| ground | score | images | megapixels | false boxes | a megapixel |",
        "|---|---|---|---|---|---|",
    ]
    for name, images in clutter_sets(data, detector):
        area = sum(image.megapixels for image in images)
        for score in thresholds:
            count = sum(false_boxes(image.above(score)) for image in images)
            lines.append(
                f"| {name} | {score:g} | {len(images)} | {area:.2f} | {count} | "
                f"{count / area:.3f} |"
            )
    return lines


def mistakes_report(data: Path, detector: Detector) -> list[str]:
    """Tabulate confident mistakes by set."""
    counts: dict[str, list[int]] = {}
    items = [
        (item.set, item.path, item.gsd_m_per_px, bool(item.labelled_vehicles))
        for table in ("table.csv", "upright.csv")
        for item in survey_table(data / "gsd" / table).images
        if item.split == "val"
    ]
    for place in places(data):
        if place.kind == "harbor":
            name = "harbours, held-out tenth" if is_held_out(place) else "harbours, train"
            items.append((name, place.path, place.gsd_m_per_px, True))
    for name, path, truth, has_cars in items:
        estimate = analyse_scale(path, detector=detector).estimate
        gsd = estimate.gsd_m_per_px
        wrong = gsd is None or abs(gsd / truth - 1) > _HIGH_ERROR or not has_cars
        row = counts.setdefault(name, [0, 0, 0])
        row[0] += 1
        row[1] += estimate.status == "ok"
        row[2] += estimate.status == "ok" and wrong
    lines = ["| images | n | ok | of these mistaken |", "|---|---|---|---|"]
    total = np.sum(list(counts.values()), axis=0)
    return lines + [
        f"| {name} | {n} | {sure} | {wrong} |"
        for name, (n, sure, wrong) in (*counts.items(), ("all", total))
    ]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector")
    parser.add_argument("--part", choices=_PARTS, action="append")
    parser.add_argument("--held-out", action="store_true")
    parser.add_argument("--thresholds", action="store_true")
    options = add_record_option(parser).parse_args()
    detector = Detector(resolve_model(options.detector))
    thresholds = list(_THRESHOLDS) if options.thresholds else [detector.card.min_score]
    print(f"Detector `{detector.card.name}`, sha256 `{detector.card.sha256}`\n")
    for part in options.part or _PARTS:
        if part == "people":
            key = "places"
            lines = people_report(people_sets(DATA, detector, options.held_out), thresholds)
        elif part == "clutter":
            key = "clutter"
            lines = clutter_report(DATA, detector, thresholds)
        else:
            key = "mistakes"
            lines = mistakes_report(DATA, detector)
        with recording(
            "detection", [key], options.record, model={detector.card.name: detector.card.sha256}
        ):
            print("\n".join(lines) + "\n", flush=True)


if __name__ == "__main__":
    main()
