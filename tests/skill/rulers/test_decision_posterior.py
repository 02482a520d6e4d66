"""Rulers that err as they say they do, fused many times: what comes out is held against issue 17's targets."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vehanchor.rulers.decision import Posterior, RulerShare, fuse_rulers, shares
from vehanchor.rulers.evidence import Evidence
from vehanchor.rulers.lognormal import LognormalEvidence, lognormal_evidence, no_evidence

SPREADS = {"vehicles": (0.09, 0.10), "camera": (0.13, 0.05), "known_length": (0.015, 0.05)}
DRAWS = 400


def _said(kind: str, gsd: float) -> LognormalEvidence:
    spread, chance_wrong = SPREADS[kind]
    return lognormal_evidence(kind, gsd, spread, chance_wrong, "{}")


def _drawn(rng: np.random.Generator, true_gsd: float, liar: str | None = None) -> list[Evidence]:
    """What all three rulers say of a scale; a liar speaks of another one, at least half as large again."""
    told = []
    for kind, (spread, _) in SPREADS.items():
        off = float(rng.normal(0, spread))
        if kind == liar:
            off = float(rng.choice([-1, 1]) * rng.uniform(math.log(1.5), math.log(5)))
        told.append(_said(kind, true_gsd * math.exp(off)))
    return list(told)


def _fused(evidence: list[Evidence]) -> Posterior:
    fused = fuse_rulers(evidence)
    assert fused is not None
    return fused


def _shares(evidence: list[Evidence]) -> dict[str, RulerShare]:
    fused = _fused(evidence)
    return {each.kind: each for each in shares(evidence, fused.gsd_m_per_px, fused.multiplied)}


def _chance(evidence: list[Evidence]) -> float:
    chance = _fused(evidence).p_within_20
    assert chance is not None
    return chance


def test_one_ruler_alone_says_what_it_says() -> None:
    told: list[Evidence] = [_said("camera", 0.05), no_evidence("known_length")]
    assert _fused(told).gsd_m_per_px == pytest.approx(0.05, rel=0.005)
    assert {kind: each.weight for kind, each in _shares(told).items()} == {"camera": 1.0}


def test_nobody_says_nothing() -> None:
    assert fuse_rulers([no_evidence("camera")]) is None
    assert fuse_rulers([]) is None


def test_the_sharper_ruler_leads_and_weights_add_up() -> None:
    told: list[Evidence] = [_said("vehicles", 0.10), _said("camera", 0.11), _said("known_length", 0.101)]
    found = _shares(told)
    assert max(found.values(), key=lambda each: each.weight).kind == "known_length"
    assert _fused(told).gsd_m_per_px == pytest.approx(0.101, rel=0.01)
    assert sum(each.weight for each in found.values()) == pytest.approx(1)
    assert all(each.agrees for each in found.values())


def test_two_that_agree_are_surer_than_either() -> None:
    one, other = _said("vehicles", 0.10), _said("camera", 0.104)
    assert _chance([one, other]) > max(_chance([one]), _chance([other]))


def test_two_that_disagree_are_a_doubt() -> None:
    told: list[Evidence] = [_said("vehicles", 0.19), _said("camera", 0.045)]
    fused = _fused(told)
    assert fused.interval.high / fused.interval.low > 3
    assert _chance(told) < 0.8
    assert sorted(each.agrees for each in _shares(told).values()) == [False, True]


def test_the_interval_of_honest_rulers_holds_the_truth() -> None:
    rng = np.random.default_rng(17)
    held = 0
    for _ in range(DRAWS):
        true_gsd = math.exp(rng.uniform(math.log(0.02), math.log(0.3)))
        kinds = rng.permutation(3)[: rng.integers(2, 4)]
        told = _drawn(rng, true_gsd)
        low, high = _fused([told[k] for k in kinds]).interval
        held += low <= true_gsd <= high
    assert held / DRAWS >= 0.93


@pytest.mark.parametrize("liar", ["camera", "known_length", "vehicles"])
def test_one_liar_of_three_is_named_and_outvoted(liar: str) -> None:
    rng = np.random.default_rng(18)
    named = near = 0
    for _ in range(DRAWS):
        true_gsd = math.exp(rng.uniform(math.log(0.02), math.log(0.3)))
        told = _drawn(rng, true_gsd, liar)
        named += not _shares(told)[liar].agrees
        near += abs(_fused(told).gsd_m_per_px / true_gsd - 1) < 0.1
    assert named / DRAWS >= 0.95
    # Without the line, 9 and 13 % of spread are left: together 7.4 %, within a tenth in 82 of 100 images at best.
    assert near / DRAWS >= (0.78 if liar == "known_length" else 0.9)
