from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import gaussian_kde

from vehanchor.errors import InvalidParameterError, TooObliqueError
from vehanchor.scale.density import (
    GRID,
    LOG_STEP,
    Votes,
    blurred,
    lognormal,
    mass_within,
    vehicle_likelihood,
)
from vehanchor.scale.lengths import (
    guard_length,
    inlier_mask,
    kde_density,
    kde_mode,
    modal_density,
    modal_length,
    statistical_log_sds,
)
from vehanchor.scale.paper import (
    FALLBACK_CONFIDENCE,
    PaperScale,
    composite,
    confidence_terms,
    paper_scale,
)
from vehanchor.scale.plane import GroundPlane

_LENGTHS = st.lists(st.floats(5, 80), min_size=2, max_size=60)


def _fleet(seed: int, n: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).normal(30, 3, n)


def test_the_outlier_filter_is_one_sided() -> None:
    assert inlier_mask([10, 10, 10, 15, 15.01]).tolist() == [True, True, True, True, False]
    assert inlier_mask([1, 2, 300], None).all()
    assert inlier_mask([]).tolist() == []


@given(_LENGTHS, st.booleans())
@settings(max_examples=40)
def test_density_equals_scipys(lengths: list[float], weighted: bool) -> None:
    assume(np.std(lengths) >= 1e-3)
    weights = np.linspace(0.2, 1.0, len(lengths)) if weighted else None
    at = np.linspace(min(lengths), max(lengths), 7)
    np.testing.assert_allclose(
        kde_density(at, lengths, weights), gaussian_kde(lengths, weights=weights)(at), rtol=1e-9
    )


@given(st.integers(0, 300), st.integers(5, 200))
@settings(max_examples=15)
@example(12, 114)  # two peaks of nearly one height
def test_the_mode_is_scipys_maximum_to_a_thousandth_of_a_pixel(seed: int, n: int) -> None:
    lengths = _fleet(seed, n)
    oracle = gaussian_kde(lengths)
    grid = np.linspace(lengths.min(), lengths.max(), 1500)
    density = oracle(grid)
    top = grid[np.argmax(density)]
    step = grid[1] - grid[0]
    best = minimize_scalar(
        lambda x: -oracle(x)[0],
        bounds=(top - step, top + step),
        method="bounded",
        options={"xatol": 1e-7},
    )
    mode = kde_mode(lengths)
    assert abs(mode - best.x) < 1e-3 or oracle(mode)[0] >= density.max() * (1 - 1e-9)


@given(_LENGTHS, st.floats(0.2, 5))
def test_scaling_the_lengths_scales_the_mode(lengths: list[float], factor: float) -> None:
    assume(np.std(lengths) >= 1e-2)
    values = np.array(lengths)
    density = kde_density(np.array([kde_mode(values * factor) / factor, kde_mode(values)]), values)
    # equal heights: the same maximum, or two that tie
    assert density[0] == pytest.approx(density[1], rel=1e-6)


def test_equal_lengths_and_a_single_one_have_a_mode() -> None:
    assert kde_mode([17.0] * 9) == pytest.approx(17.0)
    assert kde_mode([23.5]) == 23.5
    assert kde_mode([10.0, 10.0 + 1e-12]) == pytest.approx(10.0)
    assert (kde_density([1.0, 2.0], [5.0, 5.0]) == 0).all()


def test_the_mode_of_nothing_is_refused() -> None:
    with pytest.raises(InvalidParameterError):
        kde_mode([])
    with pytest.raises(InvalidParameterError):
        kde_mode([1.0, 2.0], weights=[0.0, 0.0])
    with pytest.raises(InvalidParameterError):
        kde_mode([1.0, 2.0], weights=[1.0])


def test_the_weighted_mode_is_that_of_scipys_density() -> None:
    rng = np.random.default_rng(3)
    lengths = rng.normal(30, 3, 60)
    scores = rng.uniform(0.5, 0.9, 60)
    factor = gaussian_kde(lengths, weights=scores**2 * lengths).factor
    reference = gaussian_kde(lengths, weights=scores**2 * lengths, bw_method=2 * factor)
    at = np.linspace(20, 40, 20001)
    np.testing.assert_allclose(
        modal_density(at, lengths, scores=scores, aggregation="weighted_kde"),
        reference(at),
        rtol=1e-9,
    )
    assert modal_length(lengths, scores, "weighted_kde")[0] == pytest.approx(
        at[np.argmax(reference(at))], abs=1e-3
    )


def test_the_weighted_mode_has_the_interval_of_its_own_density() -> None:
    """Twenty cars half hidden, of low score, widen the plain density's interval and hardly the weighted one's."""
    rng = np.random.default_rng(5)
    lengths = np.concatenate([rng.normal(30, 1.0, 40), rng.normal(20, 2.0, 38)])
    scores = np.concatenate([np.full(40, 0.9), np.full(38, 0.2)])
    mode, _ = modal_length(lengths, scores, "weighted_kde")
    assert (
        statistical_log_sds(lengths, scores, mode, "weighted_kde")[0]
        < statistical_log_sds(lengths, scores, mode, "kde")[0]
    )


def test_fewer_than_five_lengths_fall_back_to_the_median() -> None:
    assert modal_length([10, 11, 12, 30], np.ones(4)) == (11.5, "median")
    assert modal_length([10, 11, 12, 30], np.ones(4), "mean") == (15.75, "mean")
    assert modal_length([10, 11, 12, 13, 30], np.ones(5))[1] == "kde"
    assert modal_length([10, 11, 12, 13, 30], np.ones(5), "median") == (12.0, "median")


@given(st.integers(1, 200), st.floats(0.5, 3))
@settings(max_examples=30)
def test_the_interval_holds_the_estimate_and_scales_with_it(n: int, factor: float) -> None:
    lengths = _fleet(n, n)
    found, scaled = (_paper(each.tolist(), [0.9] * n) for each in (lengths, factor * lengths))
    assert found.gsd_m_per_px is not None
    assert found.interval is not None
    assert scaled.interval is not None
    assert 0 < found.interval.low < found.gsd_m_per_px < found.interval.high
    # a length on a histogram cell's edge may round
    assert scaled.interval.low == pytest.approx(found.interval.low / factor, rel=5e-3)
    assert _paper(lengths.tolist(), [0.9] * n) == found


def test_few_vehicles_never_give_a_narrow_interval() -> None:
    first, second, fifth, last = (
        statistical_log_sds([30.0] * n, [0.9] * n, 30.0, "kde")[1] for n in (1, 2, 5, 50)
    )
    assert first > 0.17
    assert first > second > fifth > last > 0.0


_VOTES = Votes(-2.0, 5.0)


def test_the_binned_votes_are_the_product_of_the_boxes_likelihoods() -> None:
    lengths = np.array([20.0, 22.0, 60.0])
    scores = np.array([0.9, 0.3, 0.6])
    odds = np.exp(_VOTES.log_odds(scores))
    distance = np.log(4.5 / lengths)[:, None] - GRID
    normal = np.exp(-0.5 * (distance / 0.12) ** 2) / (0.12 * np.sqrt(2 * np.pi))
    likelihood = np.prod(1 + odds[:, None] * normal, axis=0)
    expected = likelihood / likelihood.sum()
    np.testing.assert_allclose(
        vehicle_likelihood(lengths, scores, lengths_m=4.5, votes=_VOTES),
        expected,
        atol=0.03 * expected.max(),
    )


def test_a_box_of_a_low_score_says_less_than_one_of_a_high_score() -> None:
    low, high = (
        vehicle_likelihood([30.0], [score], lengths_m=4.5, votes=Votes(-13.76, 17.4))
        for score in (0.6, 0.95)
    )
    assert low.max() < high.max()
    assert low.max() < 1.5 * low.min()


@given(st.floats(0.02, 1.0), st.floats(0.02, 0.3), st.floats(0.0, 0.3), st.floats(-0.2, 0.2))
def test_an_error_adds_its_mean_and_its_variance(
    gsd: float, log_sd: float, more: float, mean: float
) -> None:
    wide = blurred(lognormal(gsd, log_sd), more, mean)
    centre = float(np.sum(wide * GRID))
    assert wide.sum() == pytest.approx(1)
    assert centre == pytest.approx(np.log(gsd) + mean, abs=0.05)
    assert np.sqrt(np.sum(wide * (GRID - centre) ** 2)) == pytest.approx(
        np.hypot(log_sd, more), abs=0.03
    )


def test_the_mass_within_a_tolerance_is_that_of_the_true_scales_it_allows() -> None:
    density = np.zeros(len(GRID))
    density[np.argmin(np.abs(GRID - np.log(0.1)))] = 1.0
    assert mass_within(density, 0.119) == pytest.approx(1, abs=LOG_STEP)
    assert mass_within(density, 0.122) == pytest.approx(0, abs=1e-9)
    assert mass_within(density, 0.081) == pytest.approx(1, abs=1e-9)
    assert mass_within(density, 0.079) == pytest.approx(0, abs=1e-9)


_RANGE = (12.0, 64.0)


@given(
    st.lists(st.tuples(st.floats(1, 500), st.floats(0, 1)), min_size=1, max_size=80), st.booleans()
)
def test_confidence_and_its_terms_lie_between_0_and_1(
    found: list[tuple[float, float]], guarded: bool
) -> None:
    lengths, scores = np.array(found).T
    terms = confidence_terms(
        lengths, scores, mode_px=float(np.median(lengths)), length_range_px=_RANGE
    )
    assert 0 <= composite(terms, guarded=guarded) <= 1


def _paper(lengths: list[float], scores: list[float], **more: float) -> PaperScale:
    seen = {"reduction": 1.0, "guard_length_px": 15.0} | more
    mode_px, aggregation = modal_length(lengths, scores)
    return paper_scale(
        lengths,
        scores,
        mode_px=mode_px,
        aggregation=aggregation,
        reference_length_m=4.5,
        reference_sd_m=0.45,
        length_range_px=_RANGE,
        **seen,
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
def test_each_term_falls_with_what_it_watches(worse: dict[str, float], term: str) -> None:
    def terms(
        n: float = 40, spread: float = 2.0, score: float = 0.7, length: float = 30.0
    ) -> float:
        lengths = length + spread * np.linspace(-1, 1, int(n))
        found = confidence_terms(
            lengths, np.full(int(n), score), mode_px=length, length_range_px=_RANGE
        )
        return float(getattr(found, term))

    assert terms(**worse) < terms()


def test_the_guard_caps_at_0_3_and_never_raises() -> None:
    good = confidence_terms(
        np.full(60, 30.0), np.full(60, 0.9), mode_px=30.0, length_range_px=_RANGE
    )
    assert composite(good, guarded=True) == 0.3
    poor = confidence_terms([30.0], [0.3], mode_px=30.0, length_range_px=_RANGE)
    assert composite(poor, guarded=True) == composite(poor, guarded=False) < 0.3


def test_the_guard_follows_the_reference_length_and_the_model() -> None:
    assert guard_length(5.045) == pytest.approx(16.82, abs=0.01)  # the paper's "about 17 px"
    assert guard_length(4.5) == pytest.approx(15.0)
    assert guard_length(4.5, min_length_px=18.0) == 18.0


def _plane(tilt: float, roll: float = 0.0, focal: float = 2000.0, gsd: float = 0.1) -> GroundPlane:
    return GroundPlane(gsd, tilt, focal_px=focal, width_px=1600, height_px=1200, roll_deg=roll)


def _mask(x: int, y: int, side: int = 40) -> np.ndarray:
    mask = np.zeros((1200, 1600), dtype=bool)
    mask[y : y + side, x : x + side] = True
    return mask


def test_straight_down_one_scale_holds_everywhere() -> None:
    plane = _plane(0.0)
    assert plane.gsd_at([[0, 0], [800, 600], [1600, 1200]]) == pytest.approx(0.1)
    assert plane.length([[10, 10]], [[13, 14]]) == pytest.approx(0.5)
    assert plane.area(_mask(3, 5)) == pytest.approx(1600 * 0.01)
    assert plane.height_m == pytest.approx(200.0)


@given(
    tilt=st.floats(0, 50), roll=st.floats(-180, 180), x=st.floats(100, 1500), y=st.floats(100, 1100)
)
def test_the_scale_of_a_pixel_is_the_root_of_the_ground_it_shows(
    tilt: float, roll: float, x: float, y: float
) -> None:
    plane = _plane(tilt, roll)
    here, right, below = plane.ground([[x, y], [x + 1e-3, y], [x, y + 1e-3]])
    area = float(np.linalg.norm(np.cross(right - here, below - here))) / 1e-6
    assert plane.gsd_at([[x, y]])[0] ** 2 == pytest.approx(area, rel=1e-3)


@given(tilt=st.floats(0, 50), roll=st.floats(-180, 180))
def test_all_of_the_ground_lies_in_one_plane_at_the_cameras_height(
    tilt: float, roll: float
) -> None:
    plane = _plane(tilt, roll)
    places = plane.ground([[100, 100], [1500, 100], [800, 600], [30, 1100]])
    assert places @ plane.down == pytest.approx(plane.height_m)
    assert np.linalg.norm(plane.down) == pytest.approx(1.0)


def test_the_upper_side_of_a_picture_shows_what_is_farther() -> None:
    upper, centre, lower = _plane(40.0).gsd_at([[800, 100], [800, 600], [800, 1100]])
    assert upper > centre > lower
    assert centre == pytest.approx(0.1)
    left, _, right = _plane(40.0, roll=90.0).gsd_at([[300, 600], [800, 600], [1300, 600]])
    assert right > left


@pytest.mark.parametrize(("x", "y"), [(0, 900), (900, 100)])
def test_the_area_under_a_mask_is_that_of_the_ground_between_its_corners(x: int, y: int) -> None:
    plane = _plane(45.0, focal=1500.0)
    first, second, third, fourth = plane.ground(
        [[x, y], [x + 200, y], [x + 200, y + 200], [x, y + 200]]
    )
    between = np.linalg.norm(np.cross(third - first, fourth - second)) / 2
    assert plane.area(_mask(x, y, 200)) == pytest.approx(between, rel=1e-4)


def test_a_mask_of_a_part_of_the_image_lies_where_it_is_said_to() -> None:
    plane = _plane(45.0)
    assert plane.area(_mask(0, 0, 20)[5:, 3:], left=3, top=5) == pytest.approx(
        plane.area(_mask(0, 0, 20)) - plane.area(_mask(0, 0, 20) & ~_mask(3, 5, 40)), rel=1e-9
    )


def test_a_horizon_in_sight_is_refused() -> None:
    with pytest.raises(TooObliqueError, match="horizon") as caught:
        _plane(80.0).check()
    assert caught.value.code == "too_oblique"
    _plane(45.0).check()
    with pytest.raises(TooObliqueError):
        _plane(80.0).gsd_at([[800, 0]])
    assert _plane(80.0).gsd_at([[800, 1100]])[0] > 0
