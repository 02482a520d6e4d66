from __future__ import annotations

import numpy as np
import pytest

from vehanchor.detection.contracts.raw import Raw

_COLUMNS = [  # cx, cy, w, h, three scores, angle
    [10.0, 11.0, 30.0, 12.0, 0.9, 0.2, 0.0, 0.5],
    [20.0, 21.0, 31.0, 13.0, 0.1, 0.3, 0.6, -9.0],
    [30.0, 31.0, 32.0, 14.0, 0.0, 0.0, 0.05, 1.0],
]
_OUTPUT = np.array(_COLUMNS, np.float32).T[None]


def test_a_place_is_an_object_of_its_best_class() -> None:
    found = Raw(3).objects([_OUTPUT], 0.1)
    np.testing.assert_allclose(found.boxes, [[10.0, 11.0, 30.0, 12.0, 0.5], [20.0, 21.0, 31.0, 13.0, -9.0]])
    np.testing.assert_allclose(found.scores, [0.9, 0.6])
    assert found.classes.tolist() == [0, 2]
    assert {array.dtype for array in (found.boxes, found.scores)} == {np.dtype(np.float64)}


@pytest.mark.parametrize(
    ("classes", "scores", "indices"), [([1], [0.2, 0.3], [1, 1]), ([0, 1], [0.9, 0.3], [0, 1]), ([2], [0.6], [2])]
)
def test_of_the_classes_asked_for_the_best_one_counts(
    classes: list[int], scores: list[float], indices: list[int]
) -> None:
    found = Raw(3).objects([_OUTPUT], 0.1, np.array(classes))
    np.testing.assert_allclose(found.scores, scores)
    assert found.classes.tolist() == indices


def test_there_is_always_room_and_there_may_be_nothing() -> None:
    assert not Raw(3).ran_out([_OUTPUT])
    nothing = Raw(3).objects([_OUTPUT], 0.95)
    assert nothing.boxes.shape == (0, 5)
    assert len(nothing.scores) == len(nothing.classes) == 0
