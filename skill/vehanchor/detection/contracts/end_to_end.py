"""Contract ``end_to_end``: one row per object after non-maximum suppression, padded with zeros."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.detection.contracts.contract import DetectorContract
from vehanchor.detection.detections import Objects

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from numpy.typing import NDArray

_WIDTH = 7
_MOST_CLASSES = 1 << 31  # the comparison also drops NaN
_LEAST_SCORE = 1e-9  # padding has 0


class EndToEnd(DetectorContract):
    """Layout ``[1, n, 7]``: a row is cx, cy, w, h, score, class, angle, padded with zeros to n (300 in practice)."""

    layout = "[1, n, 7]"

    @classmethod
    def recognise(cls, shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> EndToEnd | None:
        """Recognise rows of seven values; see ``DetectorContract.recognise``."""
        del named_classes
        return cls() if len(shapes[0]) == 3 and shapes[0][2] == _WIDTH else None

    def objects(
        self, outputs: Sequence[NDArray[Any]], min_score: float, classes: NDArray[np.intp] | None = None
    ) -> Objects:
        """Read the rows; see ``DetectorContract.objects``."""
        table = outputs[0][0].astype(np.float64)
        found = table[(table[:, 4] >= max(min_score, _LEAST_SCORE)) & (np.abs(table[:, 5]) < _MOST_CLASSES)]
        if classes is not None:
            found = found[np.isin(found[:, 5].astype(np.intp), classes)]
        return Objects(found[:, [0, 1, 2, 3, 6]], found[:, 4], found[:, 5].astype(np.intp))

    def ran_out(self, outputs: Sequence[NDArray[Any]]) -> bool:
        """Test whether no row is padding; see ``DetectorContract.ran_out``."""
        scores = outputs[0][0][:, 4]
        return bool(len(scores) and (scores > 0).all())
