"""Contract ``raw``: one column per anchor, with a score for every class."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.detection.contracts.contract import DetectorContract
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

_FIRST_SCORE = 4  # after cx, cy, w, h
_FEATURES = _FIRST_SCORE + 1  # cx, cy, w, h and the angle, which is last
_END_TO_END_WIDTH = 7


class Raw(DetectorContract):
    """Layout ``[1, 4+classes+1, anchors]``: a column is cx, cy, w, h, a score for each class, angle.

    Args:
        n_classes: number of scores in a column.
    """

    layout = "[1, 4+classes+1, anchors]"

    def __init__(self, n_classes: int) -> None:
        self.n_classes: int = n_classes

    @classmethod
    def recognise(cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> Raw | None:
        """Recognise the layout by the class names in the metadata, else because anchors outnumber the scores."""
        shape = shapes[0]
        if len(shape) != 3:
            return None
        n_classes = shape[1] - _FEATURES
        if named_classes:
            # A column has one score for every class from 0 on; any other index would address another value.
            return cls(n_classes) if set(named_classes) == set(range(n_classes)) else None
        if n_classes >= 1 and shape[1] < shape[2] != _END_TO_END_WIDTH:
            return cls(n_classes)
        return None

    def objects(
        self, outputs: Sequence[NDArray[Any]], min_score: float, classes: NDArray[np.intp] | None = None
    ) -> Objects:
        """Read the columns; see ``DetectorContract.objects``."""
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
