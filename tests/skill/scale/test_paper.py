"""The published method: interval, terms of the confidence, and the resolution guard."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vehanchor.scale.lengths import Interval, modal_length
from vehanchor.scale.paper import (
    FALLBACK_CONFIDENCE,
    PaperScale,
    composite,
    confidence_terms,
    paper_interval,
    paper_scale,
)


def _fleet(seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(30, 3, n)


@given(st.integers(1, 200), st.floats(0.5, 3))
@settings(max_examples=30)
def test_the_interval_scales_with_the_lengths(n: int, factor: float) -> None:
    lengths = _fleet(n, n)
    interval = _interval(lengths.tolist(), [0.9] * n)
    scaled = _interval((factor * lengths).tolist(), [0.9] * n)
    # a length on a histogram cell's edge may round
    assert scaled.low == pytest.approx(interval.low / factor, rel=5e-3)


@given(st.integers(1, 200))
@settings(max_examples=30)
def test_the_interval_holds_the_estimate(n: int) -> None:
    lengths = _fleet(n, n).tolist()
    paper = _paper(lengths, [0.9] * n)
    interval = _interval(lengths, [0.9] * n)
    assert paper.gsd_m_per_px is not None
    assert 0 < interval.low < paper.gsd_m_per_px < interval.high


@given(st.integers(1, 200))
@settings(max_examples=30)
def test_the_same_lengths_give_the_same_scale(n: int) -> None:
    lengths = _fleet(n, n).tolist()
    assert _paper(lengths, [0.9] * n) == _paper(lengths, [0.9] * n)
    assert _interval(lengths, [0.9] * n) == _interval(lengths, [0.9] * n)


_RANGE = (12.0, 64.0)


@given(
    st.lists(st.tuples(st.floats(1, 500), st.floats(0, 1)), min_size=1, max_size=80), st.booleans()
)
def test_the_confidence_lies_between_0_and_1(
    vehicles: list[tuple[float, float]], guarded: bool
) -> None:
    lengths, scores = np.array(vehicles).T
    terms = confidence_terms(
        lengths, scores, mode_px=float(np.median(lengths)), length_range_px=_RANGE
    )
    assert 0 <= composite(terms, guarded=guarded) <= 1


def _paper(lengths: list[float], scores: list[float], **more: float) -> PaperScale:
    seen = {"reduction": 1.0, "guard_length_px": 15.0} | more
    mode_px, _ = modal_length(lengths, scores)
    return paper_scale(
        lengths,
        scores,
        mode_px=mode_px,
        reference_length_m=4.5,
        length_range_px=_RANGE,
        **seen,
    )


def _interval(lengths: list[float], scores: list[float]) -> Interval:
    mode_px, aggregation = modal_length(lengths, scores)
    assert mode_px is not None
    return paper_interval(
        lengths,
        scores,
        mode_px=mode_px,
        aggregation=aggregation,
        reference_length_m=4.5,
        reference_sd_m=0.45,
    )


@pytest.mark.parametrize(
    ("n", "length_px", "reason"),
    [(20, 12.0, "too_coarse"), (3, 30.0, "too_few"), (3, 12.0, "too_coarse")],
)
def test_the_reason_of_a_confidence_below_one_half(n: int, length_px: float, reason: str) -> None:
    found = _paper([length_px] * n, [0.9] * n)
    assert found.confidence < FALLBACK_CONFIDENCE
    assert found.reason(n) == reason


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
def test_each_term_falls_with_its_quantity(worse: dict[str, float], term: str) -> None:
    def terms(
        n: float = 40, spread: float = 2.0, score: float = 0.7, length: float = 30.0
    ) -> float:
        lengths = length + spread * np.linspace(-1, 1, int(n))
        found = confidence_terms(
            lengths, np.full(int(n), score), mode_px=length, length_range_px=_RANGE
        )
        return float(getattr(found, term))

    assert terms(**worse) < terms()


def test_the_guard_limits_a_good_confidence_to_0_3() -> None:
    good = confidence_terms(
        np.full(60, 30.0), np.full(60, 0.9), mode_px=30.0, length_range_px=_RANGE
    )
    assert composite(good, guarded=True) == 0.3


def test_the_guard_never_raises_a_poor_confidence() -> None:
    poor = confidence_terms([30.0], [0.3], mode_px=30.0, length_range_px=_RANGE)
    assert composite(poor, guarded=True) == composite(poor, guarded=False) < 0.3
