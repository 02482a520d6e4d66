from __future__ import annotations

from pathlib import Path

import pytest

from tests.image_costs import FAMILIES, FORMATS, MIB, Cost, cost, grows_too_fast
from vehanchor.imagery.formats.header import read_header

_SIDE_PX = 2000
_OWN_MIB = 6.0  # of the decoders, whatever the size


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_what_an_image_costs_grows_no_faster_than_its_size(name: str, tmp_path: Path) -> None:
    family = FAMILIES[name]
    small, large = (cost(family.make(size), tmp_path) for size in (family.size, 4 * family.size))
    assert not grows_too_fast(small, large), (small, large)
    assert large.mebibytes < 1200  # the limit on decoded bytes, and what the process had not loaded yet


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_decoding_a_format_takes_what_its_header_predicts(name: str, tmp_path: Path) -> None:
    data = FORMATS[name](_SIDE_PX)
    predicted = read_header(lambda offset, count: data[offset : offset + count]).decoding_bytes / MIB
    measured = cost(data, tmp_path)
    assert measured.answer == "opened"
    assert measured.mebibytes <= predicted + _OWN_MIB, (measured, predicted)
    assert measured.mebibytes >= predicted / 2  # or ordinary images would be refused


def test_a_cost_that_grows_with_the_square_fails_the_check() -> None:
    assert grows_too_fast(Cost(1.0, 10, "opened"), Cost(16.0, 10, "opened"))
    assert grows_too_fast(Cost(0.1, 100, "opened"), Cost(0.1, 1600, "opened"))
    assert not grows_too_fast(Cost(1.0, 100, "opened"), Cost(4.5, 450, "opened"))
