"""Contract ``raw``: one column for each place that may hold an object, a score for every class."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.detection.contracts.contract import DetectorContract
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

_FIRST_SCORE = 4  # below cx, cy, w, h
_FEATURES = _FIRST_SCORE + 1  # and the angle, which is last
_END_TO_END_WIDTH = 7


class Raw(DetectorContract):
    """``[1, 4+classes+1, anchors]``: a column is cx, cy, w, h, a score for each class, angle.

    Args:
        n_classes: number of scores in a column.
    """

    layout = "[1, 4+classes+1, anchors]"

    def __init__(self, n_classes: int) -> None:
        self.n_classes: int = n_classes

    @classmethod
    def recognise(cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> Raw | None:
        """As for every contract: by the names in the metadata, else because there are more places than scores."""
        shape = shapes[0]
        if len(shape) != 3:
            return None
        n_classes = shape[1] - _FEATURES
        if named_classes:
            # A column has a score for every class from 0 on: other indices would be read from elsewhere in it.
            return cls(n_classes) if set(named_classes) == set(range(n_classes)) else None
        if n_classes >= 1 and shape[1] < shape[2] != _END_TO_END_WIDTH:
            return cls(n_classes)
        return None

    def objects(
        self, outputs: Sequence[NDArray[Any]], min_score: float, classes: NDArray[np.intp] | None = None
    ) -> Objects:
        """As for every contract."""
        output = outputs[0][0]
        indices = np.arange(self.n_classes) if classes is None else classes
        scores = output[_FIRST_SCORE + indices]
        best = scores[0] if len(scores) == 1 else scores.max(axis=0)
        wanted = np.flatnonzero(best >= min_score)
        return Objects(
            output[:, wanted][[0, 1, 2, 3, -1]].T.astype(np.float64),
            best[wanted].astype(np.float64),
            indices[scores[:, wanted].argmax(axis=0)],
        )
