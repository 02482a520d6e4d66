from __future__ import annotations

import numpy as np
import pytest

from vehanchor_flight.graph import Link, Unary, solve


def _ring(scales: np.ndarray, rng: np.random.Generator, *, reach: int = 3, sd: float = 0.01) -> list[Link]:
    n = len(scales)
    return [
        Link(i, (i + step) % n, float(scales[i] - scales[(i + step) % n] + rng.normal(0, sd)), sd)
        for step in range(1, reach + 1)
        for i in range(n)
    ]


def test_scales_follow_the_ratios_and_the_few_that_have_evidence() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 30)
    unaries = [Unary(float(truth[k] + rng.normal(0, 0.05)), 0.05) if k % 3 == 0 else None for k in range(30)]
    solution = solve(30, _ring(truth, rng), unaries)
    (component,) = solution.components
    assert np.abs(component.log_scales - truth).max() < 0.05
    assert solution.used.all()
    differences = component.log_scales - component.log_scales[0] - (truth - truth[0])
    assert np.abs(differences).max() < 0.04
    assert (np.abs(differences)[1:] < 4 * component.sds_from(0)[1:]).all()


@pytest.mark.parametrize("ratio", [3.0, 1 / 3.0, 1.5])
def test_a_contradiction_in_a_loop_is_found_and_dropped(ratio: float) -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 12)
    links = _ring(truth, rng)
    links.append(Link(0, 6, float(truth[0] - truth[6] + np.log(ratio)), 0.01))
    solution = solve(12, links, [Unary(float(each), 0.1) for each in truth])
    assert list(np.flatnonzero(~solution.used)) == [len(links) - 1]
    assert solution.residuals[-1] == pytest.approx(np.log(ratio), abs=0.05)
    assert np.abs(solution.components[0].log_scales - truth).max() < 0.1


def test_a_photograph_whose_own_evidence_is_wrong_is_overruled() -> None:
    rng = np.random.default_rng(2)
    truth = np.full(10, np.log(0.1))
    unaries = [Unary(float(truth[k]), 0.1) for k in range(10)]
    unaries[4] = Unary(float(truth[4] + np.log(3)), 0.05)
    (component,) = solve(10, _ring(truth, rng), unaries).components
    assert np.abs(component.log_scales - truth).max() < 0.08


def test_a_bridge_that_contradicts_the_evidence_on_both_sides_is_no_bridge() -> None:
    rng = np.random.default_rng(3)
    truth = np.full(16, np.log(0.1))
    links = [
        *_ring(truth[:8], rng),
        *(each._replace(first=each.first + 8, second=each.second + 8) for each in _ring(truth[8:], rng)),
    ]
    links.append(Link(0, 8, float(np.log(3.0)), 0.02))
    solution = solve(16, links, [Unary(float(each), 0.1) for each in truth])
    assert [len(component.members) for component in solution.components] == [8, 8]


def test_ratios_that_differ_by_more_than_they_say_widen_the_rest() -> None:
    rng = np.random.default_rng(4)
    truth = np.zeros(20)
    links = [link._replace(log_sd=0.01) for link in _ring(truth, rng, sd=0.04)]
    assert 2.5 < solve(20, links, [None] * 20).inflation < 5.5


def test_a_camera_that_looks_aside_does_not_bend_the_scales() -> None:
    rng = np.random.default_rng(5)
    columns, n = 6, 36
    aside = rng.normal(0, 0.06, (n, 2))
    links = []
    for first in range(n):
        for step, at in ((1, (0.5, 0.0)), (columns, (0.0, 0.5)), (columns + 1, (0.5, 0.5))):
            second = first + step
            if second >= n or (at[0] and first % columns == columns - 1):
                continue
            back = (-at[0], -at[1])
            ratio = aside[first] @ at - aside[second] @ back + rng.normal(0, 0.005)
            links.append(Link(first, second, float(ratio), 0.01, at, back))
    (component,) = solve(n, links, [Unary(0.0, 0.3)] * n).components
    (plain,) = solve(
        n, [link._replace(first_at=(0, 0), second_at=(0, 0)) for link in links], [Unary(0, 0.3)] * n
    ).components
    assert np.std(component.log_scales) < 0.75 * np.std(plain.log_scales)
    off = component.log_scales - component.log_scales.mean()
    assert (np.abs(off) < 3.5 * component.sds_from(int(np.argmin(np.abs(off)))).max()).all()
