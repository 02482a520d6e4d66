"""Different objects among the masks that points may mean."""

# ruff: noqa: D102 - the segmenter documents these attributes

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window

MAX_OBJECTS = 3
_SAME_IOU = 0.7  # masks that overlap more show the same object; research/results/notes.md has the trial


class Masked(Protocol):
    """Mask with its window; see ``vehanchor.segmentation.segmenter.Segmentation``."""

    @property
    def mask(self) -> NDArray[np.bool_]: ...
    @property
    def window(self) -> Window: ...
    @property
    def score(self) -> float: ...


AnyMask = TypeVar("AnyMask", bound=Masked)


def distinct(found: Sequence[AnyMask]) -> list[AnyMask]:
    """Choose the masks of different objects, at most three.

    Args:
        found: masks in windows of one image, one at least.

    Returns:
        The mask with the best score, the first of equal ones, then those of other objects by falling score; empty masks
        only if there is nothing else.
    """
    kept: list[AnyMask] = []
    for each in sorted(found, key=lambda each: (bool(each.mask.any()), each.score), reverse=True):
        if not kept or (each.mask.any() and all(_overlap(each, other) < _SAME_IOU for other in kept)):
            kept.append(each)
    return kept[:MAX_OBJECTS]


def _overlap(one: Masked, other: Masked) -> float:
    """Compute the intersection over union of two masks that are not empty."""
    first, second = one.window, other.window
    left, top = max(first.x_px, second.x_px), max(first.y_px, second.y_px)
    right = min(first.x_px + first.width_px, second.x_px + second.width_px)
    bottom = min(first.y_px + first.height_px, second.y_px + second.height_px)
    if left >= right or top >= bottom:
        return 0.0
    parts = [
        mask[top - at.y_px : bottom - at.y_px, left - at.x_px : right - at.x_px]
        for mask, at in ((one.mask, first), (other.mask, second))
    ]
    common = int((parts[0] & parts[1]).sum())
    return common / (int(one.mask.sum()) + int(other.mask.sum()) - common)
