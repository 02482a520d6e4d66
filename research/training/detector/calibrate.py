"""Calibrate a trained detector on the train split.

``python -m research.training.detector.calibrate RUN OUT.json``.

Writes what ``export.py --calibration`` puts into the file:

* ``length_correction``: factors on the boxes' lengths by length in pixels, which make them unbiased
  against labels on train images made coarser; they enter the graph;
* ``min_score``: of a few thresholds the one with the smallest mean error on the held-out tenth of
  train;
* ``aggregation``: ``weighted_kde``, see ``research/results/scale.json``;
* ``region_lengths_m``: per region the median over its train images of ``P_mode * GSD``, estimated
  as a user's image is (the paper's calibration with detections for labels, every place counting
  once: car parks hold most of the cars);
* ``reference_length_m``: the middle one of them, each region counting once, however many images it
  has;
* ``reference_length_sd_m``: their standard deviation, likewise;
* ``min_length_px``: the shortest length from which boxes are unbiased against labels, on train
  images made coarser;
* ``search_scales``: 1, the image is searched at reduced resolutions, too.
"""

from __future__ import annotations

import argparse
import csv
import json
from itertools import chain, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.detector.data import LENGTH_RANGE_PX, is_dev
from research.training.detector.export import export
from vehanchor import estimate_gsd
from vehanchor.detection.boxes import boxes_from_corners
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Search
from vehanchor.scale.defaults import Aggregation
from vehanchor.scale.lengths import inlier_mask, modal_length
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.dota import read_labels
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.table import survey_table

Boxes: TypeAlias = NDArray[np.float64]
"""Boxes ``[n, 5]``: x, y, length, width, angle."""

NAME = "vehicles"
REGION_OF_SET = {
    "cannes": "europe",
    "saopaulo": "south_america",
    "ucm": "north_america",
    "estonia": "northern_europe",
}
# Modal length of the detector's boxes in Nepal (shared/design/rulers.md).
MEASURED_ELSEWHERE = {"south_asia": 3.7}
_THRESHOLDS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
_SEARCH_SCORE = 0.1
_AGGREGATION: Aggregation = "weighted_kde"
# Beyond this error, the match is another car.
_MAX_LOG_ERROR = 0.25
# Labelled cars that an image needs to count for its region.
_LABELLED = 5
_CORRECTION_BINS_PX = (11, 13, 16, 20, 26, 34, 46, 64)
_LENGTH_BINS_PX = (8, 9, 10, 11, 12, 13, 14, 16, 18, 20, 24, 28, 34, 40, 50, 64)
# Largest log bias of a bin of lengths, beyond the bias that all bins share.
_MAX_BIAS = 0.03
_SHORT_PX = 24


class SearchedImage(NamedTuple):
    """Detections, at a low threshold, on one image of known scale."""

    image: KnownScaleImage
    detections: Detections


def region_lengths(lengths_m: list[tuple[str, float]]) -> dict[str, float]:
    """Compute the median of the images' modal lengths for each region, metres."""
    return {
        region: float(np.median([length for name, length in lengths_m if name == set_name]))
        for set_name, region in REGION_OF_SET.items()
    }


def mean_error(searched: list[SearchedImage], min_score: float) -> float:
    """Compute the mean GSD error on images with labelled cars; 1 without an estimate.

    Each region has its own reference length.
    """
    modes: list[tuple[str, float]] = []
    n_without = 0
    for image, detections in searched:
        if image.set not in REGION_OF_SET or not image.labelled_vehicles:
            continue
        is_scored = detections.scores >= min_score
        length = detections.boxes[is_scored, 2]
        score = detections.scores[is_scored]
        if not len(length):
            n_without += 1
            continue
        is_inlier = inlier_mask(length)
        mode, _ = modal_length(length[is_inlier], score[is_inlier], _AGGREGATION)
        modes.append((image.set, mode * image.gsd_m_per_px))
    own = region_lengths(modes)
    errors = [1.0] * n_without
    for name, length in modes:
        error = abs(own[REGION_OF_SET[name]] / length - 1)
        errors.append(min(1.0, error))
    return float(np.mean(errors))


def matched_lengths(boxes: Boxes, labels: Boxes) -> tuple[Boxes, Boxes]:
    """Match the lengths of detections and of labels whose centres are a fifth of a length apart."""
    if not len(boxes) or not len(labels):
        return np.zeros(0), np.zeros(0)
    offsets = boxes[:, None, :2] - labels[None, :, :2]
    gap = np.linalg.norm(offsets, axis=2)
    nearest = gap.argmin(axis=1)
    close = gap[np.arange(len(boxes)), nearest] < 0.2 * labels[nearest, 2]
    return boxes[close, 2], labels[nearest[close], 2]


class LengthPairs(NamedTuple):
    """Lengths of the same cars in pixels, all ``[n]``, and the set of images of each car."""

    detected: NDArray[np.float64]
    labelled: NDArray[np.float64]
    set: NDArray[np.str_]


def length_pairs(vehicles: Path, detector: Detector, min_score: float) -> LengthPairs:
    """Found and labelled lengths on train images made coarser."""
    pairs: list[LengthPairs] = []
    with (vehicles / "index.csv").open(newline="") as handle:
        rows = [
            r
            for r in csv.DictReader(handle)
            if r["split"] == "train" and int(r["small_vehicles"]) >= 5
        ]
    for row in rows:
        if row["set"] not in ("cannes", "saopaulo", "jekhor") or not (
            is_dev(row["file"], row["set"]) or row["set"] == "jekhor"
        ):
            continue
        image = cv2.imread(str(vehicles / row["file"]))
        labels = boxes_from_corners(
            read_labels(vehicles / "labels" / f"{Path(row['file']).stem}.txt").of_class(
                "small-vehicle"
            )
        )
        assert image is not None
        if row["set"] == "jekhor" and hash_of(row["file"]) % 8:
            continue  # an eighth of the video frames will do
        for target in (9, 10.5, 12, 14, 17, 21, 28, 40, 52):
            factor = target / float(np.median(labels[:, 2]))
            if factor > 1:
                continue
            small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
            if min(small.shape[:2]) < 32:
                continue
            with open_raster(np.ascontiguousarray(small[:, :, ::-1])) as raster:
                search = ImageSearch(raster, detector, Search(min_score=min_score))
                boxes = search.searched().boxes
            small_labels = labels * (factor, factor, factor, factor, 1)
            detected, labelled = matched_lengths(boxes, small_labels)
            pairs.append(LengthPairs(detected, labelled, np.full(len(detected), row["set"])))
    return LengthPairs(*(np.concatenate(column) for column in zip(*pairs, strict=True)))


def length_bias(pairs: LengthPairs) -> dict[int, tuple[int, float]]:
    """Compute the median of log(detected / labelled length) in bins of the labelled length.

    Returns:
        Lower edge of the bin in pixels to (number of boxes, bias).
    """
    out = {}
    for low, high in pairwise(_LENGTH_BINS_PX):
        inside = (pairs.labelled >= low) & (pairs.labelled < high)
        if inside.sum() >= 20:
            log_ratios = np.log(pairs.detected[inside] / pairs.labelled[inside])
            bias = float(np.median(log_ratios))
            out[low] = (int(inside.sum()), bias)
    return out


def length_correction(pairs: LengthPairs) -> list[tuple[float, float]]:
    """Fit factors on the detected length, at the centres of bins of the detected length.

    The log of labelled over detected length is the sum of a number for each bin and a number for
    each set (least squares): sets differ in who drew their labels, and not every set has cars of
    every length. Of the sets' numbers, only the median over the cars enters the correction.
    """
    error = np.log(pairs.labelled / pairs.detected)
    usable = (np.abs(error) < _MAX_LOG_ERROR) & (pairs.detected >= _CORRECTION_BINS_PX[0])
    usable &= pairs.detected < _CORRECTION_BINS_PX[-1]
    bins = np.digitize(pairs.detected[usable], _CORRECTION_BINS_PX) - 1
    names, sets = np.unique(pairs.set[usable], return_inverse=True)
    n_bins = len(_CORRECTION_BINS_PX) - 1
    # The first set is the base, so it has no column.
    bin_columns = np.eye(n_bins)[bins]
    set_columns = np.eye(len(names))[sets]
    design = np.column_stack([bin_columns, set_columns[:, 1:]])
    fitted = np.linalg.lstsq(design, error[usable])[0]
    common = np.median(np.append(0.0, fitted[n_bins:])[sets])
    points = []
    for (low, high), value in zip(pairwise(_CORRECTION_BINS_PX), fitted, strict=False):
        length_px = float(np.sqrt(low * high))
        factor = float(np.exp(value + common))
        points.append((round(length_px, 2), round(factor, 4)))
    return points


def hash_of(name: str) -> int:
    """Compute a stable number for a file name."""
    return sum(ord(letter) * (k + 1) for k, letter in enumerate(name))


def _first_unbiased(bias: dict[int, tuple[int, float]]) -> int:
    """Find the first bin of lengths above all biased short ones."""
    # A bias common to all lengths is a part of the reference length.
    common = float(np.median([value for _, value in bias.values()]))
    biased = [
        low
        for low, (_, value) in bias.items()
        if abs(value - common) > _MAX_BIAS and low < _SHORT_PX
    ]
    longest_biased = max(biased, default=0)
    return min((low for low in bias if low > longest_biased), default=_LENGTH_BINS_PX[0])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="of train.py")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    tables = [
        survey_table(options.data / "gsd" / name).images for name in ("table.csv", "upright.csv")
    ]
    images = [image for image in chain.from_iterable(tables) if image.split == "train"]
    calibration: dict[str, object] = {
        "name": NAME,
        "aggregation": _AGGREGATION,
        "length_range_px": ",".join(f"{side:g}" for side in LENGTH_RANGE_PX),
        "search_scales": 1,
    }
    with TemporaryDirectory() as folder:
        file = Path(folder) / "vehicles.onnx"
        export(options.run, file, calibration)
        detector = Detector(file)
        held_out = []
        search = Search(min_score=_SEARCH_SCORE, search_scales=False)
        for image in images:
            if is_dev(image.path.name, image.set):
                with open_raster(image.path) as raster:
                    vehicles = ImageSearch(raster, detector, search).searched()
                held_out.append(SearchedImage(image, vehicles))
        errors = {threshold: mean_error(held_out, threshold) for threshold in _THRESHOLDS}
        min_score = min(errors, key=lambda threshold: errors[threshold])
        for threshold, error in errors.items():
            print(
                f"min_score {threshold}: mean error {error:.4f} on the held-out tenth", flush=True
            )
        correction = length_correction(length_pairs(options.data / "vehicles", detector, min_score))
        print(f"length correction {correction}", flush=True)

        calibration |= {"min_score": min_score, "length_correction": correction}
        export(options.run, file, calibration)
        detector = Detector(file)
        bias = length_bias(length_pairs(options.data / "vehicles", detector, min_score))
        modes = [estimate_gsd(image.path, detector=detector).mode_length_px for image in images]
    for low, (count, value) in bias.items():
        print(f"labelled length from {low} px: {count} boxes, median log error {value:+.3f}")
    modal_lengths_m = [
        (image.set, mode * image.gsd_m_per_px)
        for image, mode in zip(images, modes, strict=True)
        if (image.labelled_vehicles or 0) >= _LABELLED and mode is not None
    ]
    lengths = region_lengths(modal_lengths_m)
    length_m = float(np.median(list(lengths.values())))
    log_sd = np.std(np.log(list(lengths.values())), ddof=1)
    rounded = {
        region: round(length, 4) for region, length in (lengths | MEASURED_ELSEWHERE).items()
    }
    calibration |= {
        "reference_length_m": round(length_m, 4),
        "reference_length_sd_m": round(float(length_m * log_sd), 4),
        "region_lengths_m": rounded,
        "min_length_px": float(_first_unbiased(bias)),
    }
    with whole_file(options.out) as partial:
        partial.write_text(json.dumps(calibration, indent=2) + "\n")
    print(options.out.read_text())


if __name__ == "__main__":
    main()
