"""Accuracy of a segmenter on real masks: ``python benchmarks/segmenter.py [--segmenter ENCODER DECODER]``.

Every object of at least 15 px a side, prompted by its bounding box with each side moved by up to 5 % of the box (fixed
seed); beside it, on the same prompts, GrabCut, the filled box and the inscribed ellipse. Prints Markdown, kept in
RESULTS.md.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_segmenter
from vehanchor.segmentation.prompt import Prompt
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
LEAST_SIDE_PX = 15
JITTER = 0.05  # of the box's extent, each side, uniform
_SEED = 0
_GRABCUT_ROUNDS = 5

Box = tuple[float, float, float, float]


class Target(NamedTuple):
    """One object: the image it is in, its mask (of the whole image) and the prompt."""

    category: str
    name: str
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    box: Box


class Trial(NamedTuple):
    """What a method made of one object."""

    category: str
    iou: float
    area_ratio: float  # predicted over true
    score: float
    seconds: float

    @property
    def area_error(self) -> float:
        """|area - true| / true."""
        return abs(self.area_ratio - 1)


def read_targets(folder: Path, split: str, wanted: Callable[[str], bool] | None = None) -> Iterator[Target]:
    """Objects of one split of ``shared/data/segments``; ``wanted`` chooses by the image's file name."""
    rng = np.random.default_rng(_SEED)
    with (folder / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == split]
    for row in rows:
        if wanted is not None and not wanted(row["image"]):
            continue
        image = cv2.imread(str(folder / row["image"]), cv2.IMREAD_COLOR)
        ids = cv2.imread(str(folder / row["mask"]), cv2.IMREAD_UNCHANGED)
        if image is None or ids is None:
            raise FileNotFoundError(folder / row["image"])
        rgb = np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8)
        height, width = rgb.shape[:2]
        for number in np.unique(ids)[1:]:
            mask = ids == number
            x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
            if min(w, h) < LEAST_SIDE_PX:
                continue
            moved = np.array([x, y, x + w, y + h]) + rng.uniform(-JITTER, JITTER, 4) * (w, h, w, h)
            x1, y1, x2, y2 = np.clip(moved, 0, (width, height, width, height)).tolist()
            yield Target(row["category"], row["image"], rgb, mask, (x1, y1, x2, y2))


def run_trial(target: Target, method: Callable[[Target], tuple[NDArray[np.bool_], float]]) -> Trial:
    """Compare one method's mask with the truth."""
    started = time.perf_counter()
    mask, score = method(target)
    seconds = time.perf_counter() - started
    either = int((mask | target.mask).sum())
    return Trial(
        target.category,
        float((mask & target.mask).sum() / either),
        float(mask.sum() / target.mask.sum()),
        score,
        seconds,
    )


def segmenter_method(segmenter: Segmenter) -> Callable[[Target], tuple[NDArray[np.bool_], float]]:
    """The library's own path: crop, encode, decode, place."""

    def method(target: Target) -> tuple[NDArray[np.bool_], float]:
        with open_raster(target.image) as raster:
            found = segmenter.segment(raster, Prompt(box=target.box))
        whole = np.zeros(target.mask.shape, bool)
        window = found.window
        rows = slice(window.y_px, window.y_px + window.height_px)
        whole[rows, window.x_px : window.x_px + window.width_px] = found.mask
        return whole, found.score

    return method


def _pixels(box: Box) -> tuple[int, int, int, int]:
    x1, y1, x2, y2 = (round(v) for v in box)
    return x1, y1, max(x2, x1 + 1), max(y2, y1 + 1)


def filled_box(target: Target) -> tuple[NDArray[np.bool_], float]:
    """The box itself."""
    x1, y1, x2, y2 = _pixels(target.box)
    whole = np.zeros(target.mask.shape, bool)
    whole[y1:y2, x1:x2] = True
    return whole, 1.0


def inscribed_ellipse(target: Target) -> tuple[NDArray[np.bool_], float]:
    """The ellipse that touches the box's four sides."""
    x1, y1, x2, y2 = target.box
    rows, cols = np.mgrid[: target.mask.shape[0], : target.mask.shape[1]] + 0.5
    inside = (2 * cols - x1 - x2) ** 2 / (x2 - x1) ** 2 + (2 * rows - y1 - y2) ** 2 / (y2 - y1) ** 2 <= 1
    return inside, 1.0


def grabcut(target: Target) -> tuple[NDArray[np.bool_], float]:
    """OpenCV's GrabCut started from the box, in a crop of twice the box."""
    height, width = target.mask.shape
    x1, y1, x2, y2 = _pixels(target.box)
    reach = max(x2 - x1, y2 - y1)
    left, top = max(0, (x1 + x2) // 2 - reach), max(0, (y1 + y2) // 2 - reach)
    right, bottom = min(width, (x1 + x2) // 2 + reach), min(height, (y1 + y2) // 2 + reach)
    crop = np.ascontiguousarray(target.image[top:bottom, left:right])
    labels = np.full(crop.shape[:2], cv2.GC_BGD, np.uint8)
    labels[y1 - top : y2 - top, x1 - left : x2 - left] = cv2.GC_PR_FGD
    whole = np.zeros(target.mask.shape, bool)
    if not (labels == cv2.GC_BGD).any():  # a box that fills the image leaves nothing to learn the background from
        return filled_box(target)
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(crop, labels, (0, 0, 0, 0), *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    whole[top:bottom, left:right] = (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)
    return whole, 1.0


def _row(method: str, category: str, trials: list[Trial]) -> str:
    iou = np.array([t.iou for t in trials])
    error = np.array([t.area_error for t in trials])
    bias = np.median([t.area_ratio for t in trials]) - 1
    return (
        f"| {category} | {method} | {len(trials)} | {iou.mean():.3f} | {np.median(iou):.3f} | {np.mean(iou < 0.5):.1%} "
        f"| {np.median(error):.1%} | {error.mean():.1%} | {bias:+.1%} |"
    )


def report(by_method: dict[str, list[Trial]]) -> list[str]:
    """Tables as Markdown lines."""
    ours = next(iter(by_method))
    lines = [
        "| category | method | n | mean IoU | median IoU | IoU < 0.5 | median area error | mean | median bias |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for category in sorted({t.category for t in by_method[ours]}):
        lines += [
            _row(method, category, [t for t in trials if t.category == category])
            for method, trials in by_method.items()
        ]
    lines += [_row(method, "all", trials) for method, trials in by_method.items()]
    mine = by_method[ours]
    seconds = np.array([t.seconds for t in mine])
    score, iou = np.array([t.score for t in mine]), np.array([t.iou for t in mine])
    lines += [
        "",
        f"- one prompt, encoder and decoder: median {np.median(seconds):.3f} s, 95 % below "
        f"{np.percentile(seconds, 95):.3f} s",
        f"- predicted IoU against IoU: Pearson's r {np.corrcoef(score, iou)[0, 1]:+.3f}, mean {score.mean():.3f} "
        f"against {iou.mean():.3f}",
    ]
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--split", default="val")
    parser.add_argument("--segmenter", nargs=2, metavar=("ENCODER", "DECODER"))
    parser.add_argument("--no-baselines", action="store_true")
    options = parser.parse_args()
    files = tuple(options.segmenter) if options.segmenter else None
    segmenter = Segmenter(*resolve_segmenter(files))
    methods = {segmenter.card.name: segmenter_method(segmenter)}
    if not options.no_baselines:
        methods |= {"GrabCut": grabcut, "filled box": filled_box, "inscribed ellipse": inscribed_ellipse}
    by_method: dict[str, list[Trial]] = {name: [] for name in methods}
    for target in read_targets(DATA / "segments", options.split):
        for name, method in methods.items():
            by_method[name].append(run_trial(target, method))
    print(f"Segmenter `{segmenter.card.name}`, sha256 `{segmenter.card.sha256}`, split {options.split}:\n")
    print("\n".join(report(by_method)))


if __name__ == "__main__":
    main()
