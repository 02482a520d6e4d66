"""Calibrate an exported detector on the train split: ``python -m training.detector.calibrate MODEL.onnx OUT.json``.

Writes the ``vehanchor.*`` metadata that ``export.py --calibration`` puts into the file:

* ``min_score``: of a few thresholds the one with the smallest mean error on the held-out tenth of train;
* ``region_lengths_m``: per region the KDE mode of ``P_i * GSD`` over the detections on its train images (the paper's
  calibration with detections for labels, so that the way this model draws its boxes is included);
* ``reference_length_m``: their geometric mean, each region counting once, however many images it has;
* ``reference_length_sd_m``: their standard deviation, likewise;
* ``min_length_px``: the shortest length from which boxes are unbiased against labels, on train images made coarser;
* ``search_scales``: 1, the image is searched at reduced resolutions, too;
* ``clear_score``: what the clearest tenth of the cars of an image reaches in all but 2 of 100 images with many cars.
"""

from __future__ import annotations

import argparse
import csv
import json
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from training.detector.data import LENGTH_RANGE_PX, is_dev
from vehanchor.detection import Detections, Detector, detect_vehicles
from vehanchor.evaluation.dota import read_labels
from vehanchor.evaluation.gsd import KnownScaleImage, read_table
from vehanchor.imagery import open_raster
from vehanchor.obb import boxes_from_corners
from vehanchor.scale import inlier_mask, kde_mode, modal_length

NAME = "vehicles"
REGION_OF_SET = {"cannes": "europe", "saopaulo": "south_america", "ucm": "north_america"}
_THRESHOLDS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
_SEARCH_SCORE = 0.1
_PLAUSIBLE_M = (2.5, 7.0)
_LENGTH_BINS_PX = (8, 9, 10, 11, 12, 13, 14, 16, 18, 20, 24, 28, 34, 40, 50, 64)
_MAX_BIAS = 0.03  # of the length, beyond what all bins have in common
_SHORT_PX = 24
_MANY_CARS = 20


class Found(NamedTuple):
    """Detections, at a low threshold, on one image of known scale."""

    image: KnownScaleImage
    detections: Detections


def region_lengths(found: list[Found], min_score: float) -> dict[str, float]:
    """KDE mode of the detections' metric lengths for each region."""
    out = {}
    for set_name, region in REGION_OF_SET.items():
        metres = []
        for image, detections in found:
            if image.set == set_name:
                length = detections.boxes[detections.scores >= min_score, 2]
                metres.append(length * image.gsd_m_per_px)
        pool = np.concatenate(metres)
        pool = pool[(pool > _PLAUSIBLE_M[0]) & (pool < _PLAUSIBLE_M[1])]
        out[region] = kde_mode(pool)
    return out


def mean_error(found: list[Found], min_score: float) -> float:
    """Mean GSD error on images with labelled cars, each region's own reference length used; 1 without an estimate."""
    lengths_m = region_lengths(found, min_score)
    errors = []
    for image, detections in found:
        if image.set not in REGION_OF_SET or not image.labelled_vehicles:
            continue
        wanted = detections.scores >= min_score
        length, score = detections.boxes[wanted, 2], detections.scores[wanted]
        if not len(length):
            errors.append(1.0)
            continue
        kept = inlier_mask(length)
        mode, _ = modal_length(length[kept], score[kept])
        errors.append(min(1.0, abs(lengths_m[REGION_OF_SET[image.set]] / mode / image.gsd_m_per_px - 1)))
    return float(np.mean(errors))


def matched_lengths(
    boxes: NDArray[np.float64], labels: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lengths of detections and of the labels whose centre is within a fifth of a length."""
    if not len(boxes) or not len(labels):
        return np.zeros(0), np.zeros(0)
    gap = np.linalg.norm(boxes[:, None, :2] - labels[None, :, :2], axis=2)
    nearest = gap.argmin(axis=1)
    close = gap[np.arange(len(boxes)), nearest] < 0.2 * labels[nearest, 2]
    return boxes[close, 2], labels[nearest[close], 2]


def length_bias(vehicles: Path, detector: Detector, min_score: float) -> dict[int, tuple[int, float]]:
    """Median of log(detected / labelled length) in bins of the labelled length, on train images made coarser.

    Returns:
        Lower edge of the bin in pixels to (number of boxes, bias).
    """
    pairs: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    with (vehicles / "index.csv").open(newline="") as handle:
        rows = [r for r in csv.DictReader(handle) if r["split"] == "train" and int(r["small_vehicles"]) >= 5]
    for row in rows:
        if row["set"] not in ("cannes", "saopaulo", "jekhor") or not (
            is_dev(row["file"], row["set"]) or row["set"] == "jekhor"
        ):
            continue
        image = cv2.imread(str(vehicles / row["file"]))
        labels = boxes_from_corners(
            read_labels(vehicles / "labels" / f"{Path(row['file']).stem}.txt").of_class("small-vehicle")
        )
        assert image is not None
        if row["set"] == "jekhor" and hash_of(row["file"]) % 8:
            continue  # an eighth of the video frames will do
        for target in (9, 10.5, 12, 14, 17, 21, 28, 40):
            factor = target / float(np.median(labels[:, 2]))
            if factor > 1:
                continue
            small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            if min(small.shape[:2]) < 32:
                continue
            with open_raster(np.ascontiguousarray(small[:, :, ::-1])) as raster:
                boxes = detect_vehicles(raster, detector, min_score=min_score).boxes
            pairs.append(matched_lengths(boxes, labels * (factor, factor, factor, factor, 1)))
    found, labelled = (np.concatenate(column) for column in zip(*pairs, strict=True))
    out = {}
    for low, high in pairwise(_LENGTH_BINS_PX):
        inside = (labelled >= low) & (labelled < high)
        if inside.sum() >= 20:
            out[low] = (int(inside.sum()), float(np.median(np.log(found[inside] / labelled[inside]))))
    return out


def clear_score(found: list[Found], min_score: float) -> float:
    """Low end (2nd percentile) over images with many cars of the 90th percentile of an image's scores."""
    clearest = []
    for _, detections in found:
        scores = detections.scores[detections.scores >= min_score]
        if len(scores) >= _MANY_CARS:
            clearest.append(np.percentile(scores, 90))
    return float(np.percentile(clearest, 2))


def hash_of(name: str) -> int:
    """A stable number for a file name."""
    return sum(ord(letter) * (k + 1) for k, letter in enumerate(name))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    detector = Detector(options.model)
    found = []
    for image in read_table(options.data / "gsd" / "table.csv"):
        if image.split == "train":
            with open_raster(image.path) as raster:
                found.append(Found(image, detect_vehicles(raster, detector, min_score=_SEARCH_SCORE)))
    held_out = [f for f in found if is_dev(f.image.path.name, f.image.set)]
    errors = {threshold: mean_error(held_out, threshold) for threshold in _THRESHOLDS}
    min_score = min(errors, key=lambda threshold: errors[threshold])
    for threshold, error in errors.items():
        print(f"min_score {threshold}: mean error {error:.4f} on the held-out tenth")
    lengths = region_lengths(found, min_score)
    logs = np.log(list(lengths.values()))
    bias = length_bias(options.data / "vehicles", detector, min_score)
    for low, (count, value) in bias.items():
        print(f"labelled length from {low} px: {count} boxes, median log error {value:+.3f}")
    usual = float(np.median([value for _, value in bias.values()]))  # common to all lengths: part of the reference
    biased = [low for low, (_, value) in bias.items() if abs(value - usual) > _MAX_BIAS and low < _SHORT_PX]
    first_good = min((low for low in bias if low > max(biased, default=0)), default=_LENGTH_BINS_PX[0])
    calibration = {
        "name": NAME,
        "min_score": min_score,
        "reference_length_m": round(float(np.exp(np.mean(logs))), 4),
        "reference_length_sd_m": round(float(np.exp(np.mean(logs)) * np.std(logs, ddof=1)), 4),
        "region_lengths_m": {region: round(length, 4) for region, length in lengths.items()},
        "length_range_px": ",".join(f"{side:g}" for side in LENGTH_RANGE_PX),
        "min_length_px": float(first_good),
        "search_scales": 1,
        "clear_score": round(clear_score(found, min_score) - 0.005, 2),
    }
    options.out.write_text(json.dumps(calibration, indent=2) + "\n")
    print(options.out.read_text())


if __name__ == "__main__":
    main()
