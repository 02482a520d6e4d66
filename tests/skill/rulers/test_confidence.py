from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.confidence import composite, confidence_terms, fleet_doubts
from vehanchor.scale.lengths import guard_length
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE

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


def test_no_vehicles_give_no_confidence() -> None:
    assert composite(confidence_terms([], [], float("nan"), _RANGE), guarded=False) == 0


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


@pytest.mark.parametrize(("best", "doubted"), [(0.91, True), (0.95, False)])
def test_verified_vehicles_need_a_higher_score_to_be_clear(best: float, doubted: bool) -> None:
    lengths, scores = [22.0, 23.0, 25.0, 26.0, 28.0, 35.0, 24.0], [best, best, 0.87, 0.83, 0.73, 0.6, 0.52]
    assert not fleet_doubts(lengths, scores, rival_share=0.0, clear_score=0.67)
    doubts = fleet_doubts(lengths, scores, rival_share=0.0, clear_score=0.67, verified=True)
    assert doubts == ((NoticeCode.SCORES_UNCLEAR,) if doubted else ())
