from __future__ import annotations

import numpy as np

from vehanchor.detection.contracts.end_to_end import EndToEnd

_ROWS = [  # cx, cy, w, h, score, class, angle
    [10.0, 11.0, 30.0, 12.0, 0.9, 0.0, 0.5],
    [20.0, 21.0, 31.0, 13.0, 0.6, 4.0, -9.0],
    [30.0, 31.0, 32.0, 14.0, 0.05, 0.0, 1.0],
]
_PADDING = [0.0] * 7


def _output(*rows: list[float]) -> list[np.ndarray]:
    return [np.array(rows, np.float16).reshape(1, -1, 7)]


def test_each_row_is_an_object() -> None:
    found = EndToEnd().objects(_output(*_ROWS, _PADDING), 0.1)
    np.testing.assert_allclose(found.boxes, [[10.0, 11.0, 30.0, 12.0, 0.5], [20.0, 21.0, 31.0, 13.0, -9.0]])
    np.testing.assert_allclose(found.scores, [0.9, 0.6], atol=1e-3)
    assert found.classes.tolist() == [0, 4]
    assert EndToEnd().objects(_output(*_ROWS), 0.1, np.array([4, 5])).classes.tolist() == [4]


def test_padding_is_no_object_even_without_a_threshold() -> None:
    assert len(EndToEnd().objects(_output(*_ROWS, _PADDING), 0.0)) == 3


def test_rows_ran_out_where_none_is_padding() -> None:
    assert EndToEnd().ran_out(_output(*_ROWS))
    assert not EndToEnd().ran_out(_output(*_ROWS, _PADDING))
    assert not EndToEnd().ran_out(_output())
