"""Measure an exported segmenter on the held-out tenth of train: ``python -m training.segmenter.calibrate FOLDER OUT``.

Writes JSON of the ``vehanchor.*`` metadata: the spread of the mask's area, and the predicted IoU below which a mask is
not to be trusted. Then export again with ``--calibration OUT``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.segmenter import Trial, read_targets, report, run_trial, segmenter_method
from training.segmenter.data import group_of, is_dev
from vehanchor.segmentation import Segmenter

_POOR_IOU = 0.7  # what "not to be trusted" means
_Z_95 = 1.96


def mask_area_log_sd(trials: list[Trial], least_score: float) -> float:
    """Sd of log(area / true area) whose 95 % interval holds that share of the masks scored at least ``least_score``.

    The errors have heavy tails (a mask is right, or it is of something else): a plain standard deviation would be set
    by a few failures. The 90 % quantile is used and scaled as if Gaussian when it asks for more than the 95 % one.
    """
    error = np.array([abs(np.log(max(t.area_ratio, 1e-3))) for t in trials if t.score >= least_score])
    return float(max(np.quantile(error, 0.95) / _Z_95, np.quantile(error, 0.90) / 1.645))


def least_trusted_score(trials: list[Trial]) -> float:
    """The threshold on predicted IoU that best separates masks of IoU under 0.7 (balanced accuracy)."""
    score, poor = np.array([t.score for t in trials]), np.array([t.iou < _POOR_IOU for t in trials])
    grid = np.arange(0.4, 0.86, 0.01)
    gain = [(score[poor] < limit).mean() + (score[~poor] >= limit).mean() for limit in grid]
    return round(float(grid[int(np.argmax(gain))]), 2)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="of segmenter-encoder.onnx and segmenter-decoder.onnx")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    options = parser.parse_args()
    segmenter = Segmenter(*(options.folder / f"segmenter-{half}.onnx" for half in ("encoder", "decoder")))
    held_out = read_targets(options.data, "train", lambda name: is_dev(group_of(name)))
    method = segmenter_method(segmenter)
    trials = [run_trial(target, method) for target in held_out]
    limit = least_trusted_score(trials)
    found = {"min_score": limit, "mask_area_log_sd": round(mask_area_log_sd(trials, limit), 4)}
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    print("\n".join(report({segmenter.card.name: trials})))
    print(found)


if __name__ == "__main__":
    main()
