from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

from vehanchor_flight.components import Component, single_component


def _chain() -> Component:
    """Five photographs in a row, and a doubtful short cut from the first to the last."""
    ties = np.zeros((5, 5))
    for place in range(4):
        ties[place, place + 1] = 0.01
    ties[0, 4] = 1.0
    return Component(np.arange(5), np.zeros(5), np.zeros(5), 0, csr_matrix(ties))


def test_the_way_to_a_ruler_is_the_surest_one() -> None:
    assert _chain().paths([0])[4] == (0, (3, 2, 1))
    assert _chain().paths([0])[1] == (0, ())
    assert _chain().paths([0])[0] == (0, ())


def test_of_several_sources_the_nearest_is_named() -> None:
    assert [way and way[0] for way in _chain().paths([0, 3])] == [0, 0, 3, 3, 3]


def test_photographs_of_one_scale_need_no_way() -> None:
    assert single_component([4, 7, 9], 1).paths([2, 1]) == [(2, ()), (1, ()), (2, ())]
