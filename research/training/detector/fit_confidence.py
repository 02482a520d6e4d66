"""Fit the confidence terms and the interval: ``python -m research.training.detector.fit_confidence MODEL.onnx``.

Uses the held-out tenth of the train split, each image at several resolutions (so that coarse and fine scales occur),
with its region's reference length for the confidence: what no detector can know about a fleet is the interval's
business. It prints what to write into ``vehanchor/confidence.py`` and ``vehanchor/scale.py``; nothing is read from the
val split.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.stats import spearmanr

from research.training.detector.calibrate import REGION_OF_SET
from research.training.detector.data import is_dev
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import search
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Search
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, inlier_mask, modal_length
from vehanchor_evaluation.table import read_table

_FACTORS = (0.5, 0.7, 0.85, 1.0, 1.3, 1.8)
_SAMPLE_SCALES = (4.0, 6.0, 8.0, 12.0)
_CV_RAMPS = ((0.05, 0.25), (0.05, 0.35), (0.08, 0.30), (0.08, 0.40), (0.10, 0.25), (0.12, 0.30))
_SCORE_RAMPS = ((0.3, 0.6), (0.3, 0.7), (0.4, 0.7), (0.4, 0.8), (0.5, 0.7), (0.5, 0.8), (0.55, 0.75))


class Case(NamedTuple):
    """Inputs of the confidence and the error that it predicts."""

    n: int
    variation: float
    score: float
    mode_px: float
    log_error: float  # with the region's own reference length
    log_error_unknown_region: float


def collect(table: Path, detector: Detector) -> tuple[list[Case], int]:
    """Measure the held-out tenth; return cases and the number of images without a detection."""
    cases, none = [], 0
    for image in read_table(table):
        if image.split != "train" or not is_dev(image.path.name, image.set):
            continue
        pixels = cv2.imread(str(image.path))
        assert pixels is not None
        for factor in _FACTORS:
            way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
            scaled = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=way)
            with open_raster(np.ascontiguousarray(scaled[:, :, ::-1])) as raster:
                found = search(raster, detector, Search())
            kept = inlier_mask(found.boxes[:, 2])
            length, score = found.boxes[kept, 2], found.scores[kept]
            if not len(length):
                none += 1
                continue
            mode, _ = modal_length(length, score, detector.card.aggregation)
            region = REGION_OF_SET.get(image.set)
            own = detector.card.region_lengths_m[region] if region else detector.card.reference_length_m
            truth = image.gsd_m_per_px / factor
            cases.append(
                Case(
                    len(length),
                    float(np.std(length) / np.mean(length)),
                    float(np.median(score)),
                    mode,
                    float(np.log(own / mode / truth)),
                    float(np.log(detector.card.reference_length_m / mode / truth)),
                )
            )
    return cases, none


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--table", type=Path, default=Path("../shared/data/gsd/table.csv"))
    options = parser.parse_args()
    detector = Detector(options.model)
    cases, none = collect(options.table, detector)
    n, variation, score, mode, error, error_unknown = (np.array(column) for column in zip(*cases, strict=True))
    print(f"{len(cases)} cases with an estimate, {none} without")
    for low, high in itertools.pairwise((1, 2, 5, 10, 20, 1000)):
        some = (n >= low) & (n < high)
        if some.any():
            print(f"  {low:4d} <= n < {high}: {some.sum()} cases, median error {np.median(np.abs(error[some])):.3f}")

    wrong = np.minimum(np.abs(error), 1.0)
    shortest, longest = (
        max(detector.card.min_length_px, detector.card.length_range_px[0]),
        detector.card.length_range_px[1],
    )
    outside = np.maximum(np.maximum(np.log(shortest / mode), np.log(mode / longest)), 0)
    plausible = np.clip(1 - outside / np.log(1.5), 0, 1)
    ranked = []
    for scale, (cv_full, cv_none), (score_none, score_full) in itertools.product(
        _SAMPLE_SCALES, _CV_RAMPS, _SCORE_RAMPS
    ):
        confidence = (
            0.35 * (1 - np.exp(-n / scale))
            + 0.35 * np.clip((cv_none - variation) / (cv_none - cv_full), 0, 1) * (n >= MIN_KDE_VEHICLES)
            + 0.20 * np.clip((score - score_none) / (score_full - score_none), 0, 1)
            + 0.10 * plausible
        )
        rho = spearmanr(confidence, wrong).statistic
        mistakes = float(np.mean((confidence >= 0.5) & (wrong > 0.2)))
        missed = float(np.mean(confidence[(n >= 20) & (wrong < 0.1)] < 0.5))
        ranked.append(
            (rho + 2 * mistakes + 0.5 * missed, rho, mistakes, missed, scale, cv_full, cv_none, score_none, score_full)
        )
    print("objective, rho, confident mistakes, missed, sample scale, cv full/none, score none/full")
    for row in sorted(ranked)[:5]:
        print("  " + ", ".join(f"{value:.3f}" for value in row))

    print("interval: coverage of exp(+-1.96 sigma), sigma^2 = (fleet^2 / n) + region^2, no bootstrap term")
    several = n >= 1
    for fleet, region in itertools.product((0.1, 0.2, 0.3, 0.4, 0.5), (0.0, 0.06, 0.09, 0.12)):
        known = np.abs(error[several]) < 1.96 * np.sqrt(fleet**2 / n[several] + (region / 2) ** 2)
        unknown = np.abs(error_unknown[several]) < 1.96 * np.sqrt(fleet**2 / n[several] + region**2)
        print(f"  fleet {fleet}, region {region}: known {known.mean():.3f}, unknown {unknown.mean():.3f}")


if __name__ == "__main__":
    main()
