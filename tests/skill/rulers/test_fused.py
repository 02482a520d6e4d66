"""Rulers that err as they say they do, fused many times: what comes out is held against issue 17's targets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from vehanchor.rulers.fused import FusedScale

from vehanchor.rulers.decision import fuse_rulers
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


def _fused(evidence: list[Evidence]) -> FusedScale:
    fused = fuse_rulers(evidence)
    assert fused is not None
    return fused


def test_one_ruler_alone_says_what_it_says() -> None:
    fused = _fused([_said("camera", 0.05), no_evidence("known_length")])
    assert fused.gsd_m_per_px == pytest.approx(0.05, rel=0.005)
    assert (fused.leading, len(fused.rulers), fused.rulers[0].weight) == ("camera", 1, 1.0)


def test_nobody_says_nothing() -> None:
    assert fuse_rulers([no_evidence("camera")]) is None
    assert fuse_rulers([]) is None


def test_the_sharper_ruler_leads_and_weights_add_up() -> None:
    fused = _fused([_said("vehicles", 0.10), _said("camera", 0.11), _said("known_length", 0.101)])
    assert fused.leading == "known_length"
    assert fused.gsd_m_per_px == pytest.approx(0.101, rel=0.01)
    assert sum(ruler.weight for ruler in fused.rulers) == pytest.approx(1)
    assert all(ruler.agrees for ruler in fused.rulers)


def test_two_that_agree_are_surer_than_either() -> None:
    one, other = _fused([_said("vehicles", 0.10)]), _fused([_said("camera", 0.104)])
    both = _fused([_said("vehicles", 0.10), _said("camera", 0.104)])
    assert both.p_within_20 > max(one.p_within_20, other.p_within_20)


def test_two_that_disagree_are_a_doubt() -> None:
    fused = _fused([_said("vehicles", 0.19), _said("camera", 0.045)])
    assert fused.interval.high / fused.interval.low > 3
    assert fused.p_within_20 < 0.8
    assert sorted(ruler.agrees for ruler in fused.rulers) == [False, True]


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
        fused = _fused(_drawn(rng, true_gsd, liar))
        named += not next(ruler for ruler in fused.rulers if ruler.kind == liar).agrees
        near += abs(fused.gsd_m_per_px / true_gsd - 1) < 0.1
    assert named / DRAWS >= 0.95
    # Without the line, 9 and 13 % of spread are left: together 7.4 %, within a tenth in 82 of 100 images at best.
    assert near / DRAWS >= (0.78 if liar == "known_length" else 0.9)
