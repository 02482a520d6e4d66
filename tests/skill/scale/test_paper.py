from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.scale.lengths import guard_length
from vehanchor.scale.paper import FALLBACK_CONFIDENCE, PaperScale, composite, confidence_terms, paper_scale

_RANGE = (12.0, 64.0)


@given(st.lists(st.tuples(st.floats(1, 500), st.floats(0, 1)), min_size=1, max_size=80), st.booleans())
def test_confidence_and_its_terms_lie_between_0_and_1(found: list[tuple[float, float]], guarded: bool) -> None:
    lengths, scores = np.array(found).T
    terms = confidence_terms(lengths, scores, float(np.median(lengths)), _RANGE)
    assert 0 <= composite(terms, guarded=guarded) <= 1


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_fewer_than_five_vehicles_never_reach_the_fallback_threshold(n: int) -> None:
    terms = confidence_terms(np.full(n, 30.0), np.ones(n), 30.0, _RANGE)
    assert terms.concentration == 0
    assert composite(terms, guarded=False) < FALLBACK_CONFIDENCE


def _paper(lengths: list[float], scores: list[float], **more: float) -> PaperScale:
    seen = {"seen_scale": 1.0, "guard_length_px": 15.0} | more
    return paper_scale(lengths, scores, (4.5, 0.45), "kde", length_range_px=_RANGE, **seen)


def test_no_vehicles_give_no_scale_and_no_confidence() -> None:
    found = _paper([], [])
    assert (found.gsd_m_per_px, found.interval, found.confidence) == (None, None, 0.0)


def test_the_scale_is_the_reference_length_over_the_mode_in_its_interval() -> None:
    found = _paper([30.0] * 20, [0.9] * 20)
    assert found.gsd_m_per_px == pytest.approx(0.15)
    assert found.interval is not None
    assert found.interval.low < 0.15 < found.interval.high
    assert found.reason(20) is None


@pytest.mark.parametrize(
    ("n", "length_px", "reason"), [(20, 12.0, "too_coarse"), (3, 30.0, "too_few"), (3, 12.0, "too_coarse")]
)
def test_the_reason_of_a_confidence_below_one_half(n: int, length_px: float, reason: str) -> None:
    found = _paper([length_px] * n, [0.9] * n)
    assert found.confidence < FALLBACK_CONFIDENCE
    assert found.reason(n) == reason


def test_many_equal_confident_vehicles_are_almost_certain() -> None:
    terms = confidence_terms(np.full(60, 30.0), np.full(60, 0.9), 30.0, _RANGE)
    assert composite(terms, guarded=False) > 0.95


@pytest.mark.parametrize(
    ("worse", "term"),
    [
        ({"n": 6}, "sample"),
        ({"spread": 8.0}, "concentration"),
        ({"score": 0.3}, "quality"),
        ({"length": 9.0}, "plausibility"),
        ({"length": 90.0}, "plausibility"),
    ],
)
def test_each_term_falls_with_what_it_watches(worse: dict[str, float], term: str) -> None:
    def terms(n: float = 40, spread: float = 2.0, score: float = 0.7, length: float = 30.0) -> float:
        lengths = length + spread * np.linspace(-1, 1, int(n))
        found = confidence_terms(lengths, np.full(int(n), score), length, _RANGE)
        return float(getattr(found, term))

    assert terms(**worse) < terms()


def test_the_guard_caps_at_0_3_and_never_raises() -> None:
    good = confidence_terms(np.full(60, 30.0), np.full(60, 0.9), 30.0, _RANGE)
    assert composite(good, guarded=True) == 0.3
    poor = confidence_terms([30.0], [0.3], 30.0, _RANGE)
    assert composite(poor, guarded=True) == composite(poor, guarded=False) < 0.3


def test_the_guard_follows_the_reference_length_and_the_model() -> None:
    assert guard_length(5.045) == pytest.approx(16.82, abs=0.01)  # the paper's "about 17 px"
    assert guard_length(4.5) == pytest.approx(15.0)
    assert guard_length(4.5, min_length_px=18.0) == 18.0
