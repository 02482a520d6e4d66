from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import made_card
from tests.flight.ground import facts_at, vehicles_of
from vehanchor.detection.detections import NOT_SEARCHED, Appearance, Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import ScaleOptions
from vehanchor.rulers.ruler import point_witness, prior_witness
from vehanchor.scale.density import credible_interval, lognormal
from vehanchor.scale.reliability import Shared
from vehanchor_flight.components import single_component
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.pooling import _pooled_witness, combined_density, pool, pooled_detections
from vehanchor_flight.record import conclude_flight, number_sorties
from vehanchor_flight.records import FlightEstimate

FLEET = 30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3)


def _photograph(
    lengths: NDArray[np.float64], name: str = "one", detail_share: float = 1.0
) -> Photograph:
    stored = StoredPhotograph(ImageFacts(800, 600), vehicles_of(lengths), detail_share)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def test_a_few_vehicles_in_each_photograph_have_no_mode() -> None:
    for k in range(3):
        own = _photograph(FLEET[k::3]).analysis.estimate
        assert own.details.aggregation == "median"


def test_the_boxes_of_all_photographs_make_one_mode() -> None:
    parts = [_photograph(FLEET[k::3]) for k in range(3)]
    together = pool(parts, np.zeros(3), 0).estimate
    whole = _photograph(FLEET).analysis.estimate
    assert together.n_vehicles == 9
    assert together.details.aggregation == "kde"
    assert together.mode_length_px == pytest.approx(whole.mode_length_px)
    assert together.confidence > max(part.analysis.estimate.confidence for part in parts)


def test_photographs_of_known_ratio_are_measured_in_the_pixels_of_one() -> None:
    near = _photograph(2 * FLEET)
    far = _photograph(FLEET)
    alone = _photograph(np.concatenate([FLEET, FLEET])).analysis.estimate
    log_scales = np.log([0.08, 0.16])
    in_far = pool([near, far], log_scales, 1).estimate
    in_near = pool([near, far], log_scales, 0).estimate
    # Votes lie on a grid.
    assert in_far.gsd_m_per_px == pytest.approx(alone.gsd_m_per_px, rel=1e-3)
    assert in_near.gsd_m_per_px is not None
    assert in_far.gsd_m_per_px == pytest.approx(2 * in_near.gsd_m_per_px, rel=1e-3)


def test_a_single_photograph_keeps_its_own_estimate() -> None:
    one = _photograph(FLEET)
    assert pool([one], [0.3], 0).estimate == one.analysis.estimate


def test_appearances_stay_with_their_boxes() -> None:
    first = Detections(
        np.full((3, 5), 1.0),
        np.array([0.9, 0.5, 0.3]),
        appearance=Appearance(
            log_lengths=np.array([1.9, 1.5]),
            log_sds=np.array([0.1, 0.2]),
            logits=np.array([9.0, 5.0]),
            work_chances=np.array([0.1, 0.3]),
        ),
    )
    second = Detections(
        np.full((2, 5), 2.0),
        np.array([0.8, 0.4]),
        appearance=Appearance(
            log_lengths=np.array([1.8, 1.4]),
            log_sds=np.array([0.3, 0.4]),
            logits=np.array([8.0, 4.0]),
            work_chances=np.array([0.2, 0.4]),
        ),
    )
    both = pooled_detections([first, second], np.zeros(2))
    assert both.appearance is not None
    assert list(both.appearance.logits) == [9.0, 8.0, 5.0, 4.0]
    assert list(both.appearance.log_lengths) == [1.9, 1.8, 1.5, 1.4]
    assert both.appearance.work_chances is not None
    assert list(both.appearance.work_chances) == [0.1, 0.2, 0.3, 0.4]
    assert list(both.scores) == [0.9, 0.8, 0.5, 0.4, 0.3]
    assert list(both.boxes[:, 0]) == [1, 2, 1, 2, 1]


def test_boxes_of_a_reduced_copy_keep_their_length_in_it() -> None:
    own = Detections(np.full((1, 5), 40.0), np.array([0.9]), reductions=np.array([0.5]))
    pooled = pooled_detections([own], [np.log(2.0)])
    assert pooled.reductions is not None
    length_in_copy = pooled.boxes[0, 2] * pooled.reductions[0]
    assert length_in_copy == pytest.approx(20.0)


@pytest.mark.parametrize(("gain", "narrower"), [(0.0, 1.0), (0.5, 2.0), (1.0, 4.0)])
def test_rulers_that_err_alike_gain_less_by_number(gain: float, narrower: float) -> None:
    one = lognormal(0.1, 0.2)
    low, high = credible_interval(one)
    combined_low, combined_high = credible_interval(combined_density([one] * 16, gain))
    ratio = np.log(high / low) / np.log(combined_high / combined_low)
    assert ratio == pytest.approx(narrower, rel=0.02)


def test_a_witness_of_the_flight_is_pooled_with_the_others() -> None:
    photographs = [_photograph(FLEET), _photograph(FLEET)]
    extra = point_witness("positions", 0.17, log_sd=0.05, chance_wrong=0.05, statement="{}", n=3)
    pooled = pool(photographs, np.zeros(2), 0, [extra])
    assert pooled.witnesses[1:] == (extra,)
    assert [ruler.kind for ruler in pooled.estimate.rulers] == ["vehicles", "positions"]


def test_a_prior_counts_once_per_place() -> None:
    prior = prior_witness("scene_scale", lognormal(0.13, 0.2), power=0.7, n=24)
    pooled = _pooled_witness("scene_scale", [(prior, 0.0)] * 10)
    assert prior.interval is not None
    assert pooled.interval == pytest.approx(prior.interval)
    assert pooled.chance_wrong == prior.chance_wrong
    assert not pooled.sets_scale


def test_photographs_of_one_take_off_share_its_error() -> None:
    height = Shared("height above take-off", 0.12)
    own = point_witness(
        "camera", 0.1, log_sd=0.02, chance_wrong=0.05, statement="{}", shared=[height]
    )
    pooled = _pooled_witness("camera", [(own, 0.0), (own, 0.05)])
    assert pooled.shared == (height,)
    assert pooled.chance_wrong == 0.05
    assert pooled.gsd_m_per_px == pytest.approx(0.1 * np.exp(-0.025), rel=0.01)


def _stretched(n: int, stretch: float) -> Detections:
    return Detections(np.full((n, 5), 40.0), np.full(n, 0.9), stretch=stretch)


def test_stretches_count_by_their_vehicles() -> None:
    few = _stretched(1, 9.0)
    many = _stretched(9, 0.0)
    assert pooled_detections([few, many], np.zeros(2)).stretch == pytest.approx(0.9)


def test_photographs_without_a_stretch_have_none_together() -> None:
    assert pooled_detections([NOT_SEARCHED, NOT_SEARCHED], np.zeros(2)).stretch is None


def test_stretched_photographs_are_as_doubtful_together_as_alone() -> None:
    view = _photograph(FLEET).view
    searched = replace(view.detections, reductions=np.ones(len(FLEET)), stretch=3.0)
    stored = StoredPhotograph(view.image, searched, 1.0)
    photographs = [Photograph.of(name, stored, view.card, view.options) for name in ("one", "two")]
    pooled = pool(photographs, np.zeros(2), 0).estimate
    for estimate in (photographs[0].analysis.estimate, pooled):
        assert estimate.status == "low_confidence"
        assert [warning.code for warning in estimate.warnings] == ["stretched"]


SORTIE_FLEET = 30.0 * (1 + 0.05 * np.linspace(-1, 1, 9) ** 3)
START = "2025:10:05 16:40:31"


def _taken(time: str, model: str = "FC3170") -> ImageFacts:
    facts = facts_at(0.0, 0.0)
    assert facts.camera is not None
    return facts._replace(camera=replace(facts.camera, model=model, taken_at=time))


@pytest.mark.parametrize(
    ("times", "numbers"),
    [
        # No pause is longer than 20 minutes, although the whole sortie is.
        ([START, "2025:10:05 16:59:31", "2025:10:05 17:10:00"], [0, 0, 0]),
        # An hour; photographs need not be in the order of their times.
        ([START, "2025:10:05 17:40:31", "2025:10:05 16:41:00"], [0, 1, 0]),
        # Unknown and unreadable times.
        (["", START, "yesterday"], [0, 0, 0]),
    ],
)
def test_a_pause_begins_a_sortie(times: list[str], numbers: list[int]) -> None:
    assert number_sorties([_taken(time) for time in times]) == numbers


def test_another_camera_begins_a_sortie() -> None:
    assert number_sorties([_taken(START), _taken(START, "FC220")]) == [0, 1]


def test_photographs_without_metadata_are_one_sortie() -> None:
    assert number_sorties([ImageFacts(9, 9), ImageFacts(9, 9)]) == [0, 0]


def _same_scale(*images: ImageFacts) -> FlightEstimate:
    card = made_card(5.0)
    photographs = []
    for number, image in enumerate(images):
        stored = StoredPhotograph(image, vehicles_of(SORTIE_FLEET), 1.0)
        photographs.append(Photograph.of(str(number), stored, card, ScaleOptions()))
    component = single_component(range(len(images)), 0)
    return conclude_flight(photographs, [component], card, same_scale=True)


def test_one_scale_for_two_sorties_has_a_warning() -> None:
    two = _same_scale(_taken(START), _taken("2025:10:05 18:40:31"))
    assert [photograph.sortie for photograph in two.photographs] == [0, 1]
    (warning,) = (warning for warning in two.warnings if warning.code == "several_sorties")
    assert "2 sorties of 1 and 1 photographs" in warning.message


def test_one_scale_for_one_sortie_has_no_warning() -> None:
    one = _same_scale(_taken(START), _taken("2025:10:05 16:40:33"))
    assert "several_sorties" not in {warning.code for warning in one.warnings}


def test_numbers_of_tiles_add_up() -> None:
    nothing = Detections(np.zeros((0, 5)), np.zeros(0))
    first = replace(nothing, n_tiles=3, n_capped_tiles=1, n_tiles_total=20, n_skipped=5)
    second = replace(nothing, n_tiles=4, n_capped_tiles=0, n_tiles_total=30, n_skipped=2)
    pooled = pooled_detections([first, second], np.zeros(2))
    assert pooled.n_tiles == 7
    assert pooled.n_capped_tiles == 1
    assert pooled.n_tiles_total == 50
    assert pooled.n_skipped == 7


def test_given_boxes_stay_given_in_a_pool() -> None:
    given = Detections(np.zeros((0, 5)), np.zeros(0))
    assert not pooled_detections([given, given], np.zeros(2)).were_searched
