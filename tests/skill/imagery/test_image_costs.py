from __future__ import annotations

from pathlib import Path

import pytest

from tests.image_costs import FAMILIES, Cost, cost, grows_too_fast


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_what_an_image_costs_grows_no_faster_than_its_size(name: str, tmp_path: Path) -> None:
    family = FAMILIES[name]
    small, large = (cost(family.make(size), tmp_path) for size in (family.size, 4 * family.size))
    assert not grows_too_fast(small, large), (small, large)
    assert large.mebibytes < 1200  # the limit on decoded bytes, and what the process had not loaded yet


def test_a_cost_that_grows_with_the_square_fails_the_check() -> None:
    assert grows_too_fast(Cost(1.0, 10, "opened"), Cost(16.0, 10, "opened"))
    assert grows_too_fast(Cost(0.1, 100, "opened"), Cost(0.1, 1600, "opened"))
    assert not grows_too_fast(Cost(1.0, 100, "opened"), Cost(4.5, 450, "opened"))
