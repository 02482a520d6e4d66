"""When the search of a large image ends."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from vehanchor.detection.convergence import (
    ANYTIME_PIXELS,
    LARGE_PIXELS,
    Convergence,
    has_converged,
    next_check,
    stop_rule,
)
from vehanchor.options import Search

_LARGE = LARGE_PIXELS
_CLEAR, _WIDE = Convergence(0.02, 0.08, doubted=False), Convergence(0.04, 0.08, doubted=False)
_DOUBTED = Convergence(0.01, 0.08, doubted=True)


def test_small_images_and_full_effort_never_end_early() -> None:
    small = ANYTIME_PIXELS - 1
    for options, pixels in ((Search(), small), (Search(effort="fast"), small), (Search(effort="full"), 10**9)):
        rule = stop_rule(options, pixels, 500)
        assert rule.everything is (options.effort == "full")
        assert not has_converged([_CLEAR] * 5, rule)
    assert not stop_rule(Search(max_tiles=3, effort="full"), 100, 5).everything
    assert not stop_rule(Search(max_seconds=3, effort="full"), 100, 5).everything


@pytest.mark.parametrize(
    ("value_log_sd", "unseen_share", "doubted", "ends"),
    [
        (0.012, 1.0, False, True),
        (0.013, 1.0, False, False),
        (0.024, 0.25, False, True),  # three quarters of the vehicles are seen: the others change half as much
        (0.026, 0.25, False, False),
        (0.012, 1.0, True, False),
        (math.inf, 0.0, False, False),  # fewer than five vehicles
    ],
)
def test_a_photograph_ends_when_the_other_tiles_would_change_its_value_by_little(
    value_log_sd: float, unseen_share: float, doubted: bool, ends: bool
) -> None:
    check = Convergence(0.05, 0.08, doubted, value_log_sd, unseen_share=unseen_share)
    rule = stop_rule(Search(), LARGE_PIXELS - 1, 28)
    assert has_converged([check], rule) is ends
    few = check._replace(statistical_log_sd=0.15)  # seven vehicles that agree by chance
    assert not has_converged([few], rule)


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
    checks = [stop_rule(Search(), _LARGE, 500).first_check]
    while checks[-1] < 3000:
        checks.append(next_check(checks[-1]))
    assert checks[0] == 16
    assert len(checks) < 30
    gaps = [later - earlier for earlier, later in pairwise(checks)]
    assert gaps == sorted(gaps)
