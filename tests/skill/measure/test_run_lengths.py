from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.needs import needed_module
from vehanchor.errors import PromptError
from vehanchor.measure.run_lengths import mask_of_runs, read_run_lengths

# Two columns: 0, 1, 1 and 1, 0, 0.
COUNTS = [1, 3, 2]
MASK = np.array([[0, 1], [1, 0], [1, 0]], dtype=bool)


def _mask(counts: Any, height: int = 3, width: int = 2) -> np.ndarray:
    return mask_of_runs(*read_run_lengths({"size": [height, width], "counts": counts}))


def test_runs_go_down_the_columns_and_begin_with_zeros() -> None:
    assert np.array_equal(_mask(COUNTS), MASK)


@given(arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_compressed_counts_are_those_of_pycocotools(mask: np.ndarray) -> None:
    coco = needed_module("pycocotools.mask", "pip install pycocotools")
    encoded = coco.encode(np.asfortranarray(mask, dtype=np.uint8))
    assert isinstance(encoded["counts"], bytes)
    height, width = mask.shape
    assert np.array_equal(_mask(encoded["counts"], height, width), mask)
    assert np.array_equal(_mask(encoded["counts"].decode(), height, width), mask)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ([1, 3, 3], r"have 7 pixels, but their size 3 x 2 has 6"),
        ([1, -1, 6], "at least 0"),
        ([[1, 5]], "one list"),
        (["a"], "not whole numbers"),
        ([1.0, 5.0], "not whole numbers"),
        ([[1], [2, 3]], "not whole numbers"),
        ([], "not whole numbers"),
        (None, "not whole numbers"),
        ("~~", "damaged"),
        ("h" * 30, "damaged"),
        ("h", "end within a number"),
        ([2**70], "not whole numbers"),
        ("0" * 10_000_001, "give at most 10000000"),
    ],
)
def test_bad_counts_are_refused(counts: Any, message: str) -> None:
    with pytest.raises(PromptError, match=message):
        _mask(counts)


@pytest.mark.parametrize("size", [None, [3], [0, 2], ["a", 2], [3, 2, 1], [float("inf"), 2]])
def test_a_bad_size_is_refused(size: Any) -> None:
    with pytest.raises(PromptError, match="use height, width"):
        read_run_lengths({"size": size, "counts": COUNTS})


def test_a_huge_sum_takes_no_memory() -> None:
    runs, size = read_run_lengths({"size": [1 << 20, 1 << 20], "counts": [0, 1 << 40]})
    assert (len(runs), size) == (2, (1 << 20, 1 << 20))
