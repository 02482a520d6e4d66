"""Estimates after a search over reduced copies of an image, which also finds other things."""

from __future__ import annotations

from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.scenes import Scene, render_scene
from tests.analyses import analyse_found
from tests.yards import YARDS, Yard, paint_yard
from vehanchor import estimate_gsd
from vehanchor.detection.detections import Appearance, Detections
from vehanchor.detection.detector import Detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.scale.lengths import dominant_group

if TYPE_CHECKING:
    from numpy.typing import NDArray


@pytest.fixture(scope="module")
def bundled() -> Detector:
    return Detector(resolve_model(), runtime=Runtime(threads=2))


def _fleet(mean: float, n: int = 30, spread: float = 0.07) -> list[float]:
    """Lengths as a fleet has them: normal, spread by 7 %."""
    return [mean * (1 + spread * NormalDist().inv_cdf((k + 0.5) / n)) for k in range(n)]


# --- Levels that disagree
# --------------------------------------------------------------------------------------------


def _analysis(
    detector: Detector, groups: list[tuple[float, int, float, float]], detail_share: float = 1.0
) -> Any:
    """An analysis of groups of (length, number, score, reduction), with the spread of a fleet."""
    lengths = np.concatenate([_fleet(length, n) for length, n, _, _ in groups])
    x = np.arange(len(lengths)) * 999
    boxes = np.column_stack([x, lengths * 0, lengths, lengths / 2.2, lengths * 0])
    scores = np.concatenate([np.full(n, score) for _, n, score, _ in groups])
    reductions = np.concatenate([np.full(n, reduction) for _, n, _, reduction in groups])
    return analyse_found(
        Detections(boxes, scores, reductions=reductions),
        detector.card,
        image_width_px=4000,
        image_height_px=4000,
        detail_share=detail_share,
    ).estimate


@given(
    st.lists(st.tuples(st.floats(5, 900), st.floats(0.01, 1)), min_size=1, max_size=60),
    st.randoms(use_true_random=False),
)
def test_the_dominant_group_is_a_fleet_whatever_the_order(
    found: list[tuple[float, float]], order: Any
) -> None:
    lengths, weights = (np.array(column) for column in zip(*found, strict=True))
    members, rival_share = dominant_group(lengths, weights)
    fleet = lengths[members]
    assert len(fleet) > 0
    assert fleet.max() / fleet.min() <= 1.5**2
    assert rival_share >= 0
    assert (rival_share == 0) == bool(members.all())
    shuffled = list(range(len(lengths)))
    order.shuffle(shuffled)
    again, _ = dominant_group(lengths[shuffled], weights[shuffled])
    assert sorted(lengths[shuffled][again]) == sorted(fleet)


def test_a_level_with_little_evidence_neither_moves_nor_lowers_the_answer(
    searching: Detector,
) -> None:
    alone = _analysis(searching, [(30.0, 40, 0.8, 1.0)])
    beside = _analysis(searching, [(30.0, 40, 0.8, 1.0), (190.0, 6, 0.6, 0.25)])
    assert beside.mode_length_px == pytest.approx(alone.mode_length_px)
    assert beside.n_vehicles == 40
    assert beside.confidence == pytest.approx(alone.confidence)
    assert beside.details.working_scale == 1.0
    assert beside.warnings == ()


@pytest.mark.parametrize("other", [60.0, 190.0])
def test_two_levels_that_disagree_are_never_usable(searching: Detector, other: float) -> None:
    assert _two_levels(searching, other).status == "low_confidence"


@pytest.mark.parametrize("other", [60.0, 190.0])
def test_two_levels_that_disagree_are_not_averaged(searching: Detector, other: float) -> None:
    estimate = _two_levels(searching, other)
    assert estimate.mode_length_px == pytest.approx(30.0, rel=0.02)
    assert estimate.n_vehicles == 30


def _two_levels(searching: Detector, other_px: float) -> Any:
    """Thirty vehicles of 30 px, and 26 of another length in a reduced copy."""
    reduction = 0.5 if other_px < 100 else 0.25
    return _analysis(searching, [(30.0, 30, 0.8, 1.0), (other_px, 26, 0.8, reduction)])


@pytest.mark.parametrize(
    ("n", "logit", "of_looks", "of_lengths", "of_tones", "doubt"),
    [
        (30, 3.5, 0.07, 0.10, 40.0, None),
        (30, 3.5, 0.07, 0.10, 20.0, None),  # a white fleet of different makes
        (30, 3.5, 0.03, 0.03, 40.0, "look_alikes"),
        (8, 3.5, 0.07, 0.10, 40.0, None),
        (8, 3.0, 0.03, 0.03, 8.0, "look_alikes"),
        (30, 1.5, 0.07, 0.10, 40.0, "look_alikes"),
        (8, 1.0, 0.07, 0.10, 40.0, "look_alikes"),
    ],
)
def test_things_that_do_not_look_like_a_fleet_of_cars_are_never_sure(
    searching: Detector,
    n: int,
    logit: float,
    of_looks: float,
    of_lengths: float,
    of_tones: float,
    doubt: str | None,
) -> None:
    normal = np.array([NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)])
    lengths = np.array(_fleet(40.0, n, of_lengths))
    boxes = np.column_stack([np.arange(n) * 99, lengths * 0, lengths, lengths / 2.6, lengths * 0])
    appearance = Appearance(
        np.log(4.4) + of_looks * normal,
        np.full(n, 0.07),
        logits=np.full(n, logit),
        tones=np.column_stack([120 + of_tones * normal, np.full((n, 2), 128.0)]),
    )

    def estimate(scales: NDArray[np.float64] | None) -> Any:
        found = Detections(boxes, np.full(n, 0.9), reductions=scales, appearance=appearance)
        return analyse_found(
            found, searching.card, ScaleOptions(), image_width_px=4000, image_height_px=40
        ).estimate

    searched = estimate(np.ones(n))
    assert [w.code for w in searched.warnings] == ([doubt] if doubt else [])
    assert (searched.status == "ok") is (doubt is None)
    assert estimate(None).status == "ok"  # at full resolution their size speaks for them


def test_scores_count_beside_numbers_for_the_dominant_level(searching: Detector) -> None:
    e = _analysis(searching, [(30.0, 30, 0.4, 1.0), (190.0, 20, 0.9, 0.25)])
    assert e.details.working_scale == 0.25
    assert e.mode_length_px == pytest.approx(190.0, rel=0.02)


def test_a_fleet_at_the_border_of_two_levels_is_one_fleet(searching: Detector) -> None:
    e = _analysis(searching, [(55.0, 20, 0.8, 1.0), (60.0, 18, 0.8, 0.5)])
    assert (e.status, e.n_vehicles, e.details.working_scale) == ("ok", 38, 1.0)
    assert 54 < e.mode_length_px < 61


# --- Missing detail
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("detail_share", "guarded"), [(1.0, False), (0.6, False), (0.4, True)])
def test_vehicles_without_the_detail_of_their_pixels_are_guarded(
    searching: Detector, detail_share: float, guarded: bool
) -> None:
    e = _analysis(searching, [(30.0, 40, 0.9, 1.0)], detail_share)  # the guard asks for 16.8 px
    assert (e.status == "low_confidence") is guarded
    assert [w.code for w in e.warnings] == (["detail_missing"] if guarded else [])


@pytest.mark.parametrize(("detail_share", "codes"), [(0.6, []), (0.4, ["detail_missing"])])
def test_an_image_without_vehicles_is_asked_for_its_detail(
    searching: Detector, detail_share: float, codes: list[str]
) -> None:
    e = _analysis(searching, [(30.0, 0, 0.9, 1.0)], detail_share)
    assert (e.status, e.n_vehicles) == ("no_scale", 0)
    assert [w.code for w in e.warnings] == codes


# --- The bundled model
# -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def close_view() -> Scene:
    """Cars of about 115 px, twice what the bundled model was trained on."""
    return render_scene(
        0.04, width_px=1500, height_px=1500, seed=11, layout="parking", mean_vehicle_length_m=4.6
    )


@pytest.mark.slow
def test_cars_longer_than_any_in_training_give_the_scale(
    bundled: Detector, close_view: Scene
) -> None:
    e = estimate_gsd(close_view.image, detector=bundled, search_scales=True, reference_length_m=4.6)
    assert e.gsd_m_per_px == pytest.approx(0.04, rel=0.10)
    assert e.details.working_scale in (0.25, 0.5)
    assert e.status == "ok"
    alone = estimate_gsd(
        close_view.image,
        detector=bundled,
        search_scales=False,
        rulers=("vehicles",),
        reference_length_m=4.6,
    )
    assert alone.status != "ok"


@pytest.mark.slow
@pytest.mark.parametrize("yard", YARDS)
@pytest.mark.parametrize("length_px", [30, 60, 120])
def test_a_yard_of_things_shaped_like_cars_is_never_a_confident_scale(
    bundled: Detector, yard: Yard, length_px: int
) -> None:
    image = paint_yard(yard, YARDS[yard][0] / length_px, max(500, 8 * length_px), seed=1)
    e = estimate_gsd(image, detector=bundled, search_scales=True)
    assert e.status != "ok", e
