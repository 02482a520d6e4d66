"""Properties of the answer: what a witness may and may not do to value, interval and chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vehanchor.scale.density import (
    Votes,
    blurred,
    flat,
    lognormal,
    mass_within,
    normalised,
    on_grid,
    product,
    vehicle_likelihood,
)
from vehanchor.scale.posterior import Answer, Lack, Witness, answer, judge
from vehanchor.scale.reliability import CALLER, MEASURING, Shared

VOTES = Votes(-13.76, 17.4)
LENS = Shared("lens", 0.03)
HEIGHT = Shared("height", 0.12)


def _point(
    gsd: float, log_sd: float = 0.015, chance_wrong: float = 0.05, kind: str = "line"
) -> Witness:
    return Witness(kind, gsd, right=lognormal(gsd, log_sd), chance_wrong=chance_wrong)


def _cars(n: int, gsd: float = 0.12, *, spread: float = 0.1, score: float = 0.95) -> Witness:
    log_offsets = np.zeros(1)
    if n > 1:
        log_offsets = spread * np.linspace(-1, 1, n)
    lengths = 4.5 / gsd * np.exp(log_offsets)
    votes = vehicle_likelihood(lengths, np.full(n, score), lengths_m=4.5, votes=VOTES, log_sds=0.12)
    return Witness(
        "vehicles",
        gsd,
        right=blurred(votes, 0.055, -0.015),
        chance_wrong=0.01,
    )


def _prior(gsd: float, log_sd: float = 0.22) -> Witness:
    return Witness("scene", gsd, right=lognormal(gsd, log_sd), chance_wrong=0.1, sets_scale=False)


def _numbers(decided: Answer | None) -> tuple[float, float, float, float]:
    """Value, ends of the interval, and chance."""
    assert decided is not None
    return decided.gsd_m_per_px, *decided.interval, decided.chance


# Chance below which two modes may have equal weight: the median then lies between them, or jumps.
_DECIDED = 0.55
_scales = st.floats(0.02, 0.8)
_points = st.builds(_point, _scales, st.floats(0.005, 0.3), st.floats(0.005, 0.3))
_priors = st.builds(_prior, _scales, st.floats(0.1, 0.6))
_fleets = st.builds(
    _cars, st.integers(1, 40), _scales, spread=st.floats(0.0, 0.2), score=st.floats(0.6, 1.0)
)
_setting = st.lists(st.one_of(_points, _fleets), min_size=1, max_size=3)
_witnesses = st.builds(
    lambda some, priors: [*some, *priors], _setting, st.lists(_priors, max_size=1)
)


@given(_witnesses, st.floats(0.0, 1.0))
def test_a_flat_witness_changes_nothing(witnesses: list[Witness], chance_wrong: float) -> None:
    uninformed = Witness("uninformed", 0.1, right=flat(), chance_wrong=chance_wrong)
    before = _numbers(judge(witnesses))
    assume(before[3] > _DECIDED)
    assert _numbers(judge([*witnesses, uninformed])) == pytest.approx(before, rel=1e-6)


@given(_witnesses, st.randoms(use_true_random=False))
def test_the_order_does_not_matter(witnesses: list[Witness], random: object) -> None:
    mixed = list(witnesses)
    random.shuffle(mixed)  # type: ignore[attr-defined]
    in_order = _numbers(judge(witnesses))
    assume(in_order[3] > _DECIDED)
    assert _numbers(judge(mixed)) == pytest.approx(in_order, rel=1e-6)


@given(_witnesses, st.floats(0.005, 0.15), st.floats(0.0, 0.3))
def test_a_setting_witness_at_the_value_never_makes_that_value_less_likely(
    witnesses: list[Witness], log_sd: float, chance_wrong: float
) -> None:
    """The chance itself belongs to the new value, which can move.

    Between two modes that exclude each other, the median moves towards the mode that the witness
    prefers, and the other mode is no longer within 20 % of it.
    """
    before = judge(witnesses)
    assert before is not None
    value = before.gsd_m_per_px
    supporter = _point(value, log_sd, chance_wrong=chance_wrong, kind="supporter")
    # These witnesses share no error: their posterior is the product of their densities.
    posterior = product(*(witness.density for witness in (*witnesses, supporter)))
    assert mass_within(posterior, value) >= before.chance - 1e-3


@given(
    _witnesses,
    st.sampled_from([1 / 5, 1 / 3, 1 / 2, 2, 3, 5]),
    st.floats(0.005, 0.1),
    st.floats(0.01, 0.3),
)
def test_a_witness_that_contradicts_all_others_never_makes_sure(
    witnesses: list[Witness], factor: float, log_sd: float, chance_wrong: float
) -> None:
    before = judge(witnesses)
    assert before is not None
    other_gsd = before.gsd_m_per_px * factor
    assume(on_grid(other_gsd))
    contradictory = _point(other_gsd, log_sd, chance_wrong=chance_wrong, kind="contradictory")
    assume(all(_contradicts(contradictory, witness) for witness in witnesses))
    priors = [witness for witness in witnesses if not witness.sets_scale]
    alone = judge([contradictory, *priors])
    after = judge([*witnesses, contradictory])
    assert alone is not None
    assert after is not None
    assert after.chance <= max(before.chance, alone.chance, _DECIDED) + 0.03


def _contradicts(one: Witness, other: Witness) -> bool:
    """Whether, where this witness is, the other is ten times likelier to be wrong than right."""
    assert one.right is not None
    assert other.right is not None
    right = float((one.right * other.right).sum())
    wrong = float((one.right * flat()).sum())
    return right * (1 - other.chance_wrong) < 0.1 * wrong * other.chance_wrong


@given(_setting, st.floats(0.02, 0.8), st.floats(0.01, 0.2), st.floats(0.01, 0.5))
def test_the_value_is_continuous(
    witnesses: list[Witness], gsd: float, log_sd: float, chance_wrong: float
) -> None:
    near = judge([*witnesses, _point(gsd * 1.0001, log_sd, chance_wrong)])
    here = judge([*witnesses, _point(gsd, log_sd, chance_wrong)])
    assert near is not None
    assert here is not None
    assume(max(near.chance, here.chance) > _DECIDED)
    assert near.chance == pytest.approx(here.chance, abs=0.02)
    assume(here.chance > 0.6)
    assert near.gsd_m_per_px == pytest.approx(here.gsd_m_per_px, rel=0.01)


def test_witnesses_of_one_lens_do_not_confirm_each_other() -> None:
    camera = replace(_point(0.0417, 0.005, kind="camera"), shared=(LENS, HEIGHT))
    given_height = replace(_point(0.0417, 0.05, kind="height"), shared=(LENS,))
    cars = _cars(40)
    prior = _prior(0.12)
    both = answer([cars, prior, camera, given_height])
    apart = answer([cars, prior, replace(camera, shared=()), replace(given_height, shared=())])
    assert both is not None
    assert apart is not None
    assert not both.usable
    assert both.chance > apart.chance or abs(both.gsd_m_per_px - 0.0417) > 0.01


def test_an_error_acts_only_on_the_witnesses_that_have_it() -> None:
    stretched = Shared("stretched image", 0.0, 0.001)
    look_alikes = Shared("look-alikes", 0.0, 0.999)
    cars = replace(_cars(40, gsd=0.2), shared=(stretched, look_alikes))
    prior = replace(_prior(0.2), shared=(stretched, look_alikes))
    line = replace(_point(0.12), shared=(stretched,))
    alone = answer([line])
    together = answer([cars, prior, line])
    assert alone is not None
    assert together is not None
    assert together.chance == pytest.approx(alone.chance, abs=0.01)
    assert together.p_right[2] > 0.9


def test_an_error_in_common_widens_the_product_of_its_members() -> None:
    one = replace(_point(0.1, 0.02), shared=(HEIGHT,))
    two = replace(_point(0.1, 0.02, kind="other"), shared=(HEIGHT,))
    _, low, high, _ = _numbers(answer([one, two]))
    # not 0.12 over the root of two
    assert np.log(high / low) / 3.92 == pytest.approx(0.12, rel=0.1)


@pytest.mark.parametrize("factor", [1.0, 1.3, 1.5, 2.0])
@pytest.mark.parametrize("prior_log_sd", [0.1, 0.22])
def test_a_guess_never_makes_sure(factor: float, prior_log_sd: float) -> None:
    guess = replace(_point(0.12 * factor, 0.10, kind="guess"), assumed=True, shared=(CALLER,))
    again = replace(_point(0.12 * factor, 0.10, kind="again"), assumed=True, shared=(CALLER,))
    prior = _prior(0.12, prior_log_sd)
    for witnesses in ([guess], [guess, again], [guess, prior], [guess, again, prior]):
        found = answer(witnesses)
        assert found is not None
        assert not found.usable


@pytest.mark.parametrize("factor", [1 / 1.5, 1.0, 1.5])
def test_a_prior_does_not_confirm_a_measured_fact(factor: float) -> None:
    """It does not tell a scale from one 1.5 times as large."""
    line = replace(_point(0.1), shared=(MEASURING,))
    alone = judge([line])
    confirmed = judge([line, _prior(factor * 0.1, 0.4)])
    assert alone is not None
    assert confirmed is not None
    assert confirmed.chance <= alone.chance + 0.001


def test_a_prior_that_excludes_a_measured_fact_lowers_its_chance() -> None:
    line = replace(_point(0.1), shared=(MEASURING,))
    alone = judge([line])
    contradicted = judge([line, _prior(0.5)])
    assert alone is not None
    assert contradicted is not None
    assert contradicted.chance < alone.chance - 0.1


def test_a_prior_narrows_a_guess() -> None:
    guess = replace(_point(0.12, 0.20, kind="guess"), assumed=True)
    alone = answer([guess])
    beside = answer([guess, _prior(0.12, 0.1)])
    assert alone is not None
    assert beside is not None
    assert beside.interval.high / beside.interval.low < alone.interval.high / alone.interval.low
    assert beside.chance <= alone.chance + 0.05


def test_the_witness_without_which_the_interval_is_widest_leads() -> None:
    found = answer([_cars(40), _point(0.12, 0.01), _prior(0.12)])
    assert found is not None
    assert found.leading == 1


def test_without_a_witness_that_sets_a_scale_there_is_no_answer() -> None:
    assert answer([]) is None
    assert answer([_prior(0.1)]) is None
    assert answer([_prior(0.1), Witness("none", n=0)]) is None


def test_the_reason_is_the_lack_whose_removal_raises_the_chance_most() -> None:
    more = _cars(2)
    known = _cars(1, spread=0.0)
    few = replace(
        _cars(1), chance_wrong=0.3, lacks=(Lack("too_few", more), Lack("imprecise", known))
    )
    found = answer([few])
    assert found is not None
    assert found.reason == "too_few"


def test_a_usable_scale_has_no_reason() -> None:
    found = answer([_point(0.1)])
    assert found is not None
    assert (found.usable, found.reason) == (True, None)


def _without_floor(gsd: float, shared: tuple[Shared, ...] = ()) -> Witness:
    """Make a witness that cannot be wrong, and excludes all scales except those near ``gsd``."""
    right = normalised(np.where(lognormal(gsd, 0.01) > 1e-6, 1.0, 0.0))
    return Witness("sure", gsd, right=right, chance_wrong=0.0, shared=shared)


def test_a_witness_without_a_floor_does_not_break_the_product() -> None:
    found = answer([_without_floor(0.1), _point(0.5)])
    assert found is not None
    assert found.gsd_m_per_px == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("second_gsd", [0.101, 0.5], ids=["they agree", "they exclude each other"])
@pytest.mark.parametrize("chance_wrong", [0.0, 0.02])
@pytest.mark.filterwarnings("error")
def test_witnesses_without_a_floor_that_share_an_error_give_finite_numbers(
    second_gsd: float, chance_wrong: float
) -> None:
    shared = (Shared("height", 0.12, chance_wrong),)
    witnesses = [_without_floor(0.1, shared), _without_floor(second_gsd, shared)]
    found = answer(witnesses)
    assert np.isfinite(_numbers(found)).all()
    assert found is not None
    assert np.isfinite(found.density).all()
    assert np.isfinite(found.p_right).all()


@pytest.mark.parametrize(("factor", "usable"), [(1.15, True), (1.7, False)])
def test_of_two_witnesses_far_apart_only_one_counts(factor: float, usable: bool) -> None:
    # The broad one allows the scale of the other by a large error, and stays probably right.
    exact = replace(_point(0.05, 0.02), chance_wrong=0.01)
    broad = replace(_point(0.05 * factor, 0.18 if factor > 1.5 else 0.06), chance_wrong=0.05)
    decided = answer([exact, broad])
    assert decided is not None
    assert decided.contradictions == ((0, 1),)
    assert decided.usable == usable


def test_witnesses_without_a_floor_that_exclude_each_other_are_not_sure() -> None:
    shared = (HEIGHT,)
    contradiction = answer([_without_floor(0.1, shared), _without_floor(0.5, shared)])
    assert contradiction is not None
    assert (contradiction.usable, contradiction.reason) == (False, "disagree")


def _mistake(near_share: float) -> Shared:
    return Shared("measuring", 0.0, 0.05, near_share=near_share, near_log_sd=0.5)


def test_a_near_mistake_of_one_fact_does_not_outvote_few_cars() -> None:
    line = replace(_point(0.18, chance_wrong=0.0), shared=(_mistake(near_share=0.5),))
    as_likely_anywhere = replace(line, shared=(_mistake(near_share=0.0),))
    cars = replace(_cars(2), chance_wrong=0.05)
    decided = answer([cars, line])
    other = answer([cars, as_likely_anywhere])
    assert decided is not None
    assert other is not None
    assert decided.p_right[0] > other.p_right[0]
    assert decided.p_right[1] < other.p_right[1]


@pytest.mark.parametrize("n_lines", [1, 2])
def test_a_near_mistake_does_not_widen_the_interval(n_lines: int) -> None:
    line = replace(_point(0.12, chance_wrong=0.0), shared=(_mistake(near_share=0.5),))
    as_likely_anywhere = replace(line, shared=(_mistake(near_share=0.0),))
    decided = judge([line] * n_lines)
    other = judge([as_likely_anywhere] * n_lines)
    assert decided is not None
    assert other is not None
    assert decided.interval == pytest.approx(other.interval, rel=1e-3)
    assert decided.gsd_m_per_px == pytest.approx(0.12, rel=0.01)


def _stated(gsd: float) -> Witness:
    """Make a line that its caller measured."""
    witness = _point(gsd, log_sd=0.01, chance_wrong=0.02)
    return replace(witness, shared=(MEASURING,))


def _chance_beside_doubtful_car(factor: float, n_lines: int = 1) -> float:
    """Judge measured lines at a multiple of the scale of one car that is right with 0.5."""
    car = replace(_cars(1), chance_wrong=0.4)
    lines = [_stated(0.12 * factor * (1 + 0.005 * k)) for k in range(n_lines)]
    decided = judge([car, *lines])
    assert decided is not None
    return decided.chance


@pytest.mark.parametrize("n_lines", [1, 2])
@pytest.mark.parametrize("factor", [1 / 2, 1 / 1.5, 1.4, 1.5, 2])
def test_a_doubtful_car_keeps_lines_that_it_excludes_from_being_usable(
    factor: float, n_lines: int
) -> None:
    assert _chance_beside_doubtful_car(factor, n_lines) < 0.8


@pytest.mark.parametrize("n_lines", [1, 2])
@pytest.mark.parametrize("factor", [1 / 1.1, 1.0, 1.1])
def test_a_doubtful_car_that_is_a_tenth_off_hardly_costs_a_line(
    factor: float, n_lines: int
) -> None:
    assert _chance_beside_doubtful_car(factor, n_lines) > 0.95


def test_a_contradiction_lowers_the_chance_smoothly() -> None:
    chances = [_chance_beside_doubtful_car(factor) for factor in np.linspace(1.0, 1.6, 31)]
    assert np.abs(np.diff(chances)).max() < 0.06
