"""Candidates to measure on: detections of val images at a low threshold, with their labels.

``python -m research.training.car_verifier.cases RUN`` writes ``RUN/val.npz``: boxes, today's scores with and without
the scene-scale prior, and the label that each box fits. Labels of some sets are upright: there a box fits when its
centre lies in the label and its length between 0.6 of the label's longer side and 1.25 of its diagonal.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.car_verifier.mine import overlaps
from research.training.detector.places import is_held_out, places
from vehanchor.detection.boxes import box_corners, boxes_from_corners
from vehanchor.detection.detector import Detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import search
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.dota import read_labels

_LEAST_SCORE = 0.1
_FITS = 0.4  # IoU with an oriented label
_EDGE_PX = 3.0
_NO_LABEL, _LEFT_OUT = -1, -2


class Image(NamedTuple):
    """An image to measure on."""

    set: str
    path: Path
    labels: Path | None  # None: there is no car
    upright: bool


class Cases(NamedTuple):
    """Candidates of all images, and the number of labelled cars of each set.

    Attributes:
        boxes: ``[n, 5]`` in image pixels.
        score: today's, of vehicles alone.
        size_odds: what the scene-scale prior says of each length, see ``SceneScalePrior.size_odds``.
        label: number of the label in its image that a box fits; -1 for none.
        sets: names.
        files: paths.
        set_names: of the sets.
        n_labels: labelled cars in each.
    """

    boxes: NDArray[np.float64]
    score: NDArray[np.float64]
    size_odds: NDArray[np.float64]
    label: NDArray[np.intp]
    sets: NDArray[np.str_]
    files: NDArray[np.str_]
    set_names: NDArray[np.str_]
    n_labels: NDArray[np.intp]


def val_images(data: Path) -> Iterator[Image]:
    """Val images with labels, val images without cars, crops of ``chia/``, and harbours of the held-out tenth."""
    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "val":
                path = data / "vehicles" / row["file"]
                labels = data / "vehicles" / "labels" / f"{path.stem}.txt"
                yield Image(row["set"], path, labels if labels.exists() else None, upright=False)
    with (data / "upright" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "val":
                path = data / "upright" / row["file"]
                yield Image(row["set"], path, data / "upright" / "labels" / f"{path.stem}.txt", True)
    with (data / "chia" / "crops.csv").open(newline="") as handle:  # its cars are in ``looked_at.csv``
        for row in csv.DictReader(handle):
            yield Image("chia", data / "chia" / row["file"], None, upright=False)
    for place in places(data):
        if place.kind == "harbor" and is_held_out(place):
            yield Image("harbor", place.path, None, False)


def fitted_upright(boxes: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.intp]:
    """The upright label that each box fits, the nearest of several; -1 for none."""
    out = np.full(len(boxes), _NO_LABEL)
    if not len(corners) or not len(boxes):
        return out
    low, high = corners.min(axis=1), corners.max(axis=1)
    side, middle = high - low, (low + high) / 2
    gap = np.abs(boxes[:, None, :2] - middle[None])
    inside = (gap < 0.55 * side).all(axis=2)
    length = boxes[:, 2, None]
    long = (length > 0.6 * side.max(axis=1)) & (length < 1.25 * np.hypot(*side.T))
    far = np.where(inside & long, np.linalg.norm(gap, axis=2), np.inf)
    nearest = far.argmin(axis=1)
    fits = np.isfinite(far.min(axis=1))
    out[fits] = nearest[fits]
    return out


def fitted(image: Image, boxes: NDArray[np.float64], width: int, height: int) -> tuple[NDArray[np.intp], int]:
    """The label that each box fits, -1 for none and -2 for what counts neither way; and how many labels count."""
    out = np.full(len(boxes), _NO_LABEL)
    if image.labels is None:
        return out, 0
    labels = read_labels(image.labels, [])
    corners = labels.of_class("small-vehicle")
    edge = np.array([width, height])
    whole = (corners > _EDGE_PX).all(axis=(1, 2)) & (corners < edge - _EDGE_PX).all(axis=(1, 2))
    if image.upright:
        out = fitted_upright(boxes, corners)
    elif len(corners):
        iou, which = overlaps(boxes, boxes_from_corners(corners))
        out = np.where(iou >= _FITS, which, _NO_LABEL)
    out[(out >= 0) & ~np.append(whole, True)[out]] = _LEFT_OUT
    reach = box_corners(boxes)
    cut = (reach < 0).any(axis=(1, 2)) | (reach > edge).any(axis=(1, 2))
    out[cut & (out == _NO_LABEL)] = _LEFT_OUT
    for polygon in labels.of_class("ignore"):
        for k in np.flatnonzero(out == _NO_LABEL):
            centre = (float(boxes[k, 0]), float(boxes[k, 1]))
            if cv2.pointPolygonTest(polygon.astype(np.float32), centre, measureDist=True) > -0.3 * boxes[k, 2]:
                out[k] = _LEFT_OUT
    return out, int(whole.sum())


def collected(data: Path) -> Cases:
    """Search all images."""
    detector, prior = Detector(resolve_model(), runtime=Runtime(threads=1)), load_scene_scale()
    detector.car_verifier = None  # its candidates are wanted
    assert prior is not None
    columns: list[list[NDArray[np.generic]]] = [[] for _ in range(6)]
    n_labels: dict[str, int] = {}
    for image in val_images(data):
        with open_raster(image.path) as raster:
            scene = prior.predict(raster)
            found = search(raster, detector, Search(min_score=_LEAST_SCORE))
            width, height = raster.width_px, raster.height_px
        label, count = fitted(image, found.boxes, width, height)
        n_labels[image.set] = n_labels.get(image.set, 0) + count
        kept = label != _LEFT_OUT
        some = int(kept.sum())
        odds = np.broadcast_to(scene.size_odds(found.boxes[:, 2]), len(found.boxes))
        for column, values in zip(
            columns,
            (
                found.boxes[kept],
                found.scores[kept],
                odds[kept],
                label[kept],
                np.full(some, image.set),
                np.full(some, str(image.path)),
            ),
            strict=True,
        ):
            column.append(np.asarray(values))
    joined = [np.concatenate([each for each in column if len(each)]) for column in columns]
    return Cases(*joined, np.array(list(n_labels)), np.array(list(n_labels.values())))  # type: ignore[arg-type, call-arg]


def read_cases(path: Path) -> Cases:
    """Read what ``main`` wrote."""
    with np.load(path) as stored:
        return Cases(**{name: stored[name] for name in Cases._fields})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    cases = collected(options.data)
    with whole_file(options.run / "val.npz") as partial, partial.open("wb") as handle:
        np.savez(handle, **cases._asdict())
    for name, count in zip(cases.set_names, cases.n_labels, strict=True):
        of_set = cases.sets == name
        print(f"{name}: {count} cars, {of_set.sum()} candidates, {(cases.label[of_set] >= 0).sum()} fit")


if __name__ == "__main__":
    main()
