"""Which rulers agree, and when a prior is left out."""

from __future__ import annotations

import pytest

from vehanchor.rulers.agreement import disagreements, outvoted_priors
from vehanchor.rulers.decision import Posterior, RulerShare, fuse_rulers, shares
from vehanchor.rulers.evidence import Evidence
from vehanchor.rulers.lognormal import lognormal, lognormal_evidence
from vehanchor.scale.fusion import credible_interval, with_outlier_floor


def _ruler(kind: str, gsd: float, log_sd: float, chance_wrong: float = 0.05) -> Evidence:
    return lognormal_evidence(kind, gsd, log_sd, chance_wrong, "{}")


def _prior(gsd: float, log_sd: float) -> Evidence:
    """A prior as sure as its calibration allows."""
    density = with_outlier_floor(lognormal(gsd, log_sd), 0.02)
    return Evidence("scene_scale", gsd, credible_interval(density), 24, 0.0, (), density)


CAMERA, POSITIONS = _ruler("camera", 0.0177, 0.05), _ruler("positions", 0.0158, 0.045)
FALSE_VEHICLE = _ruler("vehicles", 0.060, 0.12, 0.3)


def _fused(*evidence: Evidence) -> tuple[Posterior, dict[str, RulerShare]]:
    fused = fuse_rulers(evidence)
    assert fused is not None
    return fused, {each.kind: each for each in shares(evidence, fused.gsd_m_per_px, fused.multiplied)}


def test_rulers_whose_intervals_overlap_agree() -> None:
    assert CAMERA.interval is not None
    assert POSITIONS.interval is not None
    assert CAMERA.interval.low < POSITIONS.interval.high
    assert disagreements([CAMERA, POSITIONS]) == []
    (apart,) = disagreements([CAMERA, _ruler("positions", 0.0125, 0.045)])
    assert apart.code == "rulers_disagree"


def test_a_prior_does_not_outvote_two_rulers_that_agree() -> None:
    prior = _prior(0.059, 0.08)
    fused, found = _fused(FALSE_VEHICLE, prior, CAMERA, POSITIONS)
    assert fused.gsd_m_per_px == pytest.approx(0.0167, rel=0.05)
    assert fused.p_within_20 is not None
    assert fused.p_within_20 > 0.9
    assert (found["scene_scale"].weight, found["scene_scale"].agrees) == (0.0, False)
    assert "scene_scale" not in fused.multiplied
    (warning,) = outvoted_priors([FALSE_VEHICLE, prior, CAMERA, POSITIONS]).values()
    assert warning.message == (
        "The scene-scale prior says 0.059 m/px. It is left out, because other rulers agree: "
        "the camera metadata say 0.018, the positions say 0.016 m/px."
    )


def test_a_prior_that_agrees_with_one_of_them_counts() -> None:
    prior = _prior(0.02, 0.2)
    fused, found = _fused(prior, CAMERA, POSITIONS)
    assert outvoted_priors([prior, CAMERA, POSITIONS]) == {}
    assert found["scene_scale"].weight > 0
    assert "scene_scale" in fused.multiplied


@pytest.mark.parametrize("other", [[], [_ruler("positions", 0.2, 0.045)]])
def test_a_prior_counts_where_no_two_rulers_agree(other: list[Evidence]) -> None:
    prior = _prior(0.059, 0.08)
    assert outvoted_priors([prior, CAMERA, *other]) == {}
    assert "scene_scale" in _fused(prior, CAMERA, *other)[0].multiplied
