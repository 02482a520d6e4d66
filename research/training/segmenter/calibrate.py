"""Calibrate a trained segmenter on the held-out tenth of train.

``python -m research.training.segmenter.calibrate RUN OUT``.

Writes JSON for ``export.py --calibration OUT``:

* ``mask_smoothing`` and ``mask_offset``: the blur of the mask's logits, in cells, and what is added
  to them, since the loss alone leaves masks ragged and too small: the pair with the best mean IoU
  at which no category comes out more than 1 % too large (an overestimated clearing is the dangerous
  error);
* ``mask_area_log_sd``: the spread of the mask's area;
* ``min_score``: the predicted IoU below which a mask is not to be trusted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
import torch

from research.training.segmenter.data import group_of, is_dev
from research.training.segmenter.export import INPUT_PX, export, smoothed
from research.training.segmenter.trials import Target, Trial, read_targets, report, run_trial
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.session import open_session
from vehanchor.segmentation.contracts import recognise_contract
from vehanchor.segmentation.crop import crop_side, crop_window, place_mask, read_resized
from vehanchor.segmentation.prompt import Prompt
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from vehanchor.segmentation.contracts import MaskLogits, SamContract

_GOOD_IOU = 0.7
_Z_95 = 1.96
_OFFSETS = (0.0, 0.25, 0.5, 0.75, 1.0)
_SMOOTHINGS = (0.0, 0.5, 0.7, 0.85, 1.0)
_MAX_TOO_LARGE = 0.01


def mask_area_log_sd(trials: list[Trial], least_score: float) -> float:
    """Compute the sd of log(area / true area) of masks scored at least ``least_score``.

    Its 95 % interval holds that share of the masks.

    The errors have heavy tails (a mask is right, or it is of something else): a plain standard
    deviation would be set by a few failures. The 90 % quantile is used and scaled as if Gaussian
    when it asks for more than the 95 % one.
    """
    error = np.array(
        [abs(np.log(max(t.area_ratio, 1e-3))) for t in trials if t.score >= least_score]
    )
    return float(max(np.quantile(error, 0.95) / _Z_95, np.quantile(error, 0.90) / 1.645))


def least_trusted_score(trials: list[Trial]) -> float:
    """Compute the predicted IoU that 95 of 100 good masks (IoU of 0.7 and more) reach."""
    good = [t.score for t in trials if t.iou >= _GOOD_IOU]
    return math.floor(100 * float(np.percentile(good, 5))) / 100


def area_bias(trials: list[Trial]) -> dict[str, float]:
    """Compute the median of area / true area - 1 by category."""
    categories = sorted({t.category for t in trials})
    return {
        name: float(np.median([t.area_ratio for t in trials if t.category == name])) - 1
        for name in categories
    }


def see(contract: SamContract, target: Target) -> MaskLogits:
    """Segment as the library does, up to the logits."""
    prompt = Prompt(box=target.box)
    with open_raster(target.image) as raster:
        window = crop_window(
            prompt, raster.width_px, image_height_px=raster.height_px, side_px=crop_side(prompt)
        )
        size = contract.input_size(window.width_px, window.height_px)
        crop = contract.encode(read_resized(raster, window, size), window)
        return contract.decode(crop, prompt)


def finished(
    view: MaskLogits, smoothing: float, offset: float
) -> Callable[[Target], tuple[NDArray[np.bool_], float]]:
    """Compute the mask of the whole image from smoothed and raised logits, and its score."""

    def method(target: Target) -> tuple[NDArray[np.bool_], float]:
        logits = smoothed(torch.from_numpy(view.logits)[None, None], smoothing)[
            0, 0
        ].numpy() + np.float32(offset)
        window = view.window
        whole = np.zeros(target.mask.shape, bool)
        placed = place_mask(replace(view, logits=logits))
        whole[
            window.y_px : window.y_px + window.height_px,
            window.x_px : window.x_px + window.width_px,
        ] = placed
        return whole, view.score

    return method


def best_choice(by_choice: dict[tuple[float, float], list[Trial]]) -> tuple[float, float]:
    """Choose smoothing and offset by the mean IoU, with no category too large; None without any."""
    allowed = [
        choice
        for choice, trials in by_choice.items()
        if max(area_bias(trials).values()) <= _MAX_TOO_LARGE
    ]
    return max(
        allowed,
        key=lambda choice: float(np.mean([t.iou for t in by_choice[choice]])),
        default=(0.0, 0.0),
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="of train.py")
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    options = parser.parse_args()
    targets = list(read_targets(options.data, "train", lambda name: is_dev(group_of(name))))
    with TemporaryDirectory() as folder:
        sessions = [open_session(path) for path in export(options.run, Path(folder), {})]
        views = [
            see(recognise_contract(sessions[0], sessions[1], INPUT_PX), target)
            for target in targets
        ]
    by_choice: dict[tuple[float, float], list[Trial]] = {}
    for choice in itertools.product(_SMOOTHINGS, _OFFSETS):
        by_choice[choice] = [
            run_trial(target, finished(view, *choice))
            for target, view in zip(targets, views, strict=True)
        ]
    smoothing, offset = best_choice(by_choice)
    trials = by_choice[smoothing, offset]
    print(f"smoothing {smoothing}, offset {offset}: area bias {area_bias(trials)}", flush=True)
    limit = least_trusted_score(trials)
    results = {
        "mask_offset": offset,
        "mask_smoothing": smoothing,
        "min_score": limit,
        "mask_area_log_sd": round(mask_area_log_sd(trials, limit), 4),
    }
    with whole_file(options.out) as partial:
        partial.write_text(json.dumps(results, indent=1) + "\n")
    print("\n".join(report({"held out": trials})))
    print(results)


if __name__ == "__main__":
    main()
