"""Measure a segmenter on real masks.

``python -m research.benchmarks.segmenter [--segmenter ENCODER DECODER]``.

Every object of at least 15 px a side is prompted by its bounding box, each side moved by up to 5 %
of the box (fixed seed). Beside it, on the same prompts: GrabCut. Prints Markdown; ``--record``
keeps it.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from research.results.record import add_record_option, recording
from research.training.segmenter.trials import Box, Target, Trial, read_targets, report, run_trial
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_segmenter
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    ScoredMask: TypeAlias = tuple[NDArray[np.bool_], float]
    """Mask of an object, and its score."""

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_GRABCUT_ROUNDS = 5


def segmenter_method(segmenter: Segmenter) -> Callable[[Target], ScoredMask]:
    """Run the library's own path: crop, encode, decode, place."""

    def method(target: Target) -> ScoredMask:
        with open_raster(target.image) as raster:
            segmentation = segmenter.segment(raster, Prompt(box=target.box), copy_px=0.0)
        whole = np.zeros(target.mask.shape, bool)
        window = segmentation.window
        rows = slice(window.y_px, window.y_px + window.height_px)
        whole[rows, window.x_px : window.x_px + window.width_px] = segmentation.mask
        return whole, segmentation.score

    return method


def _pixels(box: Box) -> tuple[int, int, int, int]:
    x1, y1, x2, y2 = (round(v) for v in box)
    return x1, y1, max(x2, x1 + 1), max(y2, y1 + 1)


def filled_box(target: Target) -> ScoredMask:
    """Return the box itself."""
    x1, y1, x2, y2 = _pixels(target.box)
    whole = np.zeros(target.mask.shape, bool)
    whole[y1:y2, x1:x2] = True
    return whole, 1.0


def grabcut(target: Target) -> ScoredMask:
    """Run OpenCV's GrabCut from the box, in a crop of twice the box."""
    height, width = target.mask.shape
    x1, y1, x2, y2 = _pixels(target.box)
    reach = max(x2 - x1, y2 - y1)
    left = max(0, (x1 + x2) // 2 - reach)
    top = max(0, (y1 + y2) // 2 - reach)
    right = min(width, (x1 + x2) // 2 + reach)
    bottom = min(height, (y1 + y2) // 2 + reach)
    crop = np.ascontiguousarray(target.image[top:bottom, left:right])
    labels = np.full(crop.shape[:2], cv2.GC_BGD, np.uint8)
    labels[y1 - top : y2 - top, x1 - left : x2 - left] = cv2.GC_PR_FGD
    whole = np.zeros(target.mask.shape, bool)
    # A box that fills the image leaves no background to learn.
    if not (labels == cv2.GC_BGD).any():
        return filled_box(target)
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(crop, labels, (0, 0, 0, 0), *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    whole[top:bottom, left:right] = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    return whole, 1.0


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--split", default="val")
    parser.add_argument("--segmenter", nargs=2, metavar=("ENCODER", "DECODER"))
    parser.add_argument("--no-baseline", action="store_true")
    options = add_record_option(parser).parse_args()
    files = tuple(options.segmenter) if options.segmenter else None
    segmenter = Segmenter(*resolve_segmenter(files))
    methods = {segmenter.card.name: segmenter_method(segmenter)}
    if not options.no_baseline:
        methods["GrabCut"] = grabcut
    by_method: dict[str, list[Trial]] = {name: [] for name in methods}
    for target in read_targets(DATA / "segments", options.split):
        for name, method in methods.items():
            by_method[name].append(run_trial(target, method))
    print(
        f"Segmenter `{segmenter.card.name}`, sha256 `{segmenter.card.sha256}`, split "
        f"{options.split}:\n"
    )
    with recording(
        "areas",
        ["segmenter", "segmenter_scores"],
        options.record,
        model={segmenter.card.name: segmenter.card.sha256},
    ):
        print("\n".join(report(by_method)))


if __name__ == "__main__":
    main()
