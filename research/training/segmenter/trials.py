"""Trials of a segmenter on real masks: prompts, comparison with the truth, tables.

Each object of at least 15 px a side is prompted by its bounding box. Each side of the box is moved
by up to 5 % of the box's extent, with a fixed seed.
"""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.results.record import values_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

LEAST_SIDE_PX = 15
# Uniform shift of each side of the box, as a share of its extent.
JITTER = 0.05
_SEED = 0

Box = tuple[float, float, float, float]


class Target(NamedTuple):
    """One object: the image it is in, its mask (of the whole image) and the prompt."""

    category: str
    name: str
    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    box: Box


class Trial(NamedTuple):
    """Result of a method for one object."""

    category: str
    iou: float
    area_ratio: float  # predicted over true
    score: float
    seconds: float

    @property
    def area_error(self) -> float:
        """|area - true| / true."""
        return abs(self.area_ratio - 1)


def read_targets(
    folder: Path, split: str, is_wanted: Callable[[str], bool] | None = None
) -> Iterator[Target]:
    """Load objects of a split of ``shared/data/segments``; ``is_wanted`` selects by file name."""
    rng = np.random.default_rng(_SEED)
    with (folder / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == split]
    for row in rows:
        if is_wanted is not None and not is_wanted(row["image"]):
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
            box = np.array([x, y, x + w, y + h])
            moved = box + rng.uniform(-JITTER, JITTER, 4) * (w, h, w, h)
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
        area_ratio=float(mask.sum() / target.mask.sum()),
        score=score,
        seconds=seconds,
    )


def _row(method: str, category: str, trials: list[Trial]) -> str:
    iou = np.array([t.iou for t in trials])
    error = np.array([t.area_error for t in trials])
    bias = np.median([t.area_ratio for t in trials]) - 1
    return (
        f"| {category} | {method} | {len(trials)} | {iou.mean():.3f} | {np.median(iou):.3f} | "
        f"{np.mean(iou < 0.5):.1%} "
        f"| {np.median(error):.1%} | {error.mean():.1%} | {bias:+.1%} |"
    )


def report(by_method: dict[str, list[Trial]]) -> list[str]:
    """Format tables as Markdown lines."""
    ours = next(iter(by_method))
    lines = [
        "| category | method | n | mean IoU | median IoU | IoU < 0.5 | median area error | mean "
        "| median bias |",
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
    score = np.array([t.score for t in mine])
    iou = np.array([t.iou for t in mine])
    values = {
        "one prompt, encoder and decoder: median, s": np.median(seconds),
        "one prompt, encoder and decoder: 95 % below, s": np.percentile(seconds, 95),
        "predicted IoU against IoU: Pearson's r": np.corrcoef(score, iou)[0, 1],
        "predicted IoU, mean": score.mean(),
        "IoU, mean": iou.mean(),
    }
    return [*lines, "", *values_table(values)]
