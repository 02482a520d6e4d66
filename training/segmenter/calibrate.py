"""Calibrate a trained segmenter on the held-out tenth of train: ``python -m training.segmenter.calibrate RUN OUT``.

Writes JSON for ``export.py --calibration OUT``:

* ``mask_offset``: what is added to the mask's logits, since the loss alone leaves masks too small: the most at which no
  category comes out more than 1 % too large (an overestimated clearing is the dangerous error);
* ``mask_area_log_sd``: the spread of the mask's area;
* ``min_score``: the predicted IoU below which a mask is not to be trusted.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.segmenter import Trial, read_targets, report, run_trial, segmenter_method
from training.segmenter.data import group_of, is_dev
from training.segmenter.export import export
from vehanchor.output import whole_file
from vehanchor.segmentation.segmenter import Segmenter

_GOOD_IOU = 0.7
_Z_95 = 1.96
_OFFSETS = (0.0, 0.25, 0.5, 0.75, 1.0)
_MOST_TOO_LARGE = 0.01


def mask_area_log_sd(trials: list[Trial], least_score: float) -> float:
    """Sd of log(area / true area) whose 95 % interval holds that share of the masks scored at least ``least_score``.

    The errors have heavy tails (a mask is right, or it is of something else): a plain standard deviation would be set
    by a few failures. The 90 % quantile is used and scaled as if Gaussian when it asks for more than the 95 % one.
    """
    error = np.array([abs(np.log(max(t.area_ratio, 1e-3))) for t in trials if t.score >= least_score])
    return float(max(np.quantile(error, 0.95) / _Z_95, np.quantile(error, 0.90) / 1.645))


def least_trusted_score(trials: list[Trial]) -> float:
    """The predicted IoU that 95 of 100 good masks (IoU of 0.7 and more) reach."""
    good = [t.score for t in trials if t.iou >= _GOOD_IOU]
    return math.floor(100 * float(np.percentile(good, 5))) / 100


def area_bias(trials: list[Trial]) -> dict[str, float]:
    """Median of area / true area - 1 by category."""
    categories = sorted({t.category for t in trials})
    return {name: float(np.median([t.area_ratio for t in trials if t.category == name])) - 1 for name in categories}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="of train.py")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    options = parser.parse_args()
    targets = list(read_targets(options.data, "train", lambda name: is_dev(group_of(name))))
    by_offset: dict[float, list[Trial]] = {}
    with TemporaryDirectory() as folder:
        for offset in _OFFSETS:
            segmenter = Segmenter(*export(options.run, Path(folder), {"mask_offset": offset}))
            method = segmenter_method(segmenter)
            by_offset[offset] = [run_trial(target, method) for target in targets]
            print(f"offset {offset}: area bias {area_bias(by_offset[offset])}", flush=True)
    best = max(o for o in _OFFSETS if o == 0 or max(area_bias(by_offset[o]).values()) <= _MOST_TOO_LARGE)
    trials = by_offset[best]
    limit = least_trusted_score(trials)
    found = {
        "mask_offset": best,
        "min_score": limit,
        "mask_area_log_sd": round(mask_area_log_sd(trials, limit), 4),
    }
    with whole_file(options.out) as partial:
        partial.write_text(json.dumps(found, indent=1) + "\n")
    print("\n".join(report({"held out": trials})))
    print(found)


if __name__ == "__main__":
    main()
