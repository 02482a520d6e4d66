"""When the search of a large image ends."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from vehanchor.detection.convergence import ANYTIME_PIXELS, Convergence, has_converged, next_check, stop_rule
from vehanchor.options import Search

_LARGE = ANYTIME_PIXELS
_CLEAR, _WIDE = Convergence(0.02, 0.08, doubted=False), Convergence(0.04, 0.08, doubted=False)
_DOUBTED = Convergence(0.01, 0.08, doubted=True)


def test_small_images_and_full_effort_never_end_early() -> None:
    small = _LARGE - 1
    for options, pixels in ((Search(), small), (Search(effort="fast"), small), (Search(effort="full"), 10**9)):
        rule = stop_rule(options, pixels, 500)
        assert not rule.anytime
        assert not has_converged([_CLEAR] * 5, rule)
    assert stop_rule(Search(max_tiles=3), 100, 5).anytime
    assert stop_rule(Search(max_seconds=3, effort="full"), 100, 5).anytime


@pytest.mark.parametrize(
    ("standings", "ends"),
    [
        ([_CLEAR], False),
        ([_CLEAR, _CLEAR], True),
        ([_CLEAR, _WIDE], False),
        ([_CLEAR, _DOUBTED], False),
        ([_DOUBTED, _CLEAR], False),
        ([_WIDE, _CLEAR, _CLEAR], True),
        ([Convergence(math.inf, 0.0, doubted=True)] * 3, False),
        ([Convergence(0.02, 0.0, doubted=False)] * 3, False),
        ([Convergence(0.009, 0.0, doubted=False)] * 3, True),
    ],
)
def test_two_checks_in_a_row_without_a_doubt_end_the_search(standings: list[Convergence], ends: bool) -> None:
    assert has_converged(standings, stop_rule(Search(), _LARGE, 500)) is ends


def test_fast_ends_sooner_and_after_a_twentieth_of_the_tiles_at_the_latest() -> None:
    rule = stop_rule(Search(effort="fast"), _LARGE, 2000)
    assert has_converged([_WIDE], rule)
    assert not has_converged([_DOUBTED], rule)
    assert rule.max_tiles == 100
    assert stop_rule(Search(effort="fast", max_tiles=7), _LARGE, 2000).max_tiles == 7
    assert stop_rule(Search(effort="fast"), _LARGE, 40).max_tiles == 24


def test_checks_come_ever_more_rarely() -> None:
    checks = [next_check(0)]
    while checks[-1] < 3000:
        checks.append(next_check(checks[-1]))
    assert checks[0] == 16
    assert len(checks) < 30
    gaps = [later - earlier for earlier, later in pairwise(checks)]
    assert gaps == sorted(gaps)
