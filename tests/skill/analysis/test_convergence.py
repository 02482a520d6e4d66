"""When the search of a large image ends."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from vehanchor.analysis.convergence import Convergence, has_converged, stop_rule
from vehanchor.detection.limits import ANYTIME_PIXELS, LARGE_PIXELS, next_pause, search_limits
from vehanchor.options import Search

_LARGE = LARGE_PIXELS
_CLEAR, _WIDE = Convergence(0.02, 0.08, doubted=False), Convergence(0.04, 0.08, doubted=False)
_DOUBTED = Convergence(0.01, 0.08, doubted=True)


def test_small_images_and_full_effort_never_end_early() -> None:
    small = ANYTIME_PIXELS - 1
    for options, pixels in ((Search(), small), (Search(effort="fast"), small), (Search(effort="full"), 10**9)):
        limits = search_limits(options, pixels, 500)
        assert limits.everything is (options.effort == "full")
        assert limits.first_pause is None
    assert not search_limits(Search(max_tiles=3, effort="full"), 100, 5).everything
    assert not search_limits(Search(max_seconds=3, effort="full"), 100, 5).everything


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
    rule = stop_rule("auto", LARGE_PIXELS - 1)
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
    assert has_converged(standings, stop_rule("auto", _LARGE)) is ends


def test_fast_ends_sooner_and_after_a_twentieth_of_the_tiles_at_the_latest() -> None:
    rule = stop_rule("fast", _LARGE)
    assert has_converged([_WIDE], rule)
    assert not has_converged([_DOUBTED], rule)
    assert search_limits(Search(effort="fast"), _LARGE, 2000).max_tiles == 100
    assert search_limits(Search(effort="fast", max_tiles=7), _LARGE, 2000).max_tiles == 7
    assert search_limits(Search(effort="fast"), _LARGE, 40).max_tiles == 24


def test_pauses_come_ever_more_rarely() -> None:
    first = search_limits(Search(), _LARGE, 500).first_pause
    assert first == 16
    pauses = [first]
    while pauses[-1] < 3000:
        pauses.append(next_pause(pauses[-1]))
    assert len(pauses) < 30
    gaps = [later - earlier for earlier, later in pairwise(pauses)]
    assert gaps == sorted(gaps)
