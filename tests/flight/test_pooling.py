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


def _photograph(
    lengths: NDArray[np.float64], name: str = "one", detail_share: float = 1.0
) -> Photograph:
    stored = StoredPhotograph(ImageFacts(800, 600), vehicles_of(lengths), detail_share)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


_FLEET = 30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3)


def test_the_boxes_of_all_photographs_make_one_mode() -> None:
    parts = [_photograph(_FLEET[k::3]) for k in range(3)]
    together = pool(parts, np.zeros(3), 0).estimate
    assert [part.analysis.estimate.details.aggregation for part in parts] == [
        "median"
    ] * 3  # three vehicles are too few
    assert together.n_vehicles == 9
    assert together.details.aggregation == "kde"
    assert together.mode_length_px == pytest.approx(
        _photograph(_FLEET).analysis.estimate.mode_length_px
    )
    assert together.confidence > max(part.analysis.estimate.confidence for part in parts)


def test_photographs_of_known_ratio_are_measured_in_the_pixels_of_one() -> None:
    near = _photograph(2 * _FLEET)
    far = _photograph(_FLEET)
    alone = _photograph(np.concatenate([_FLEET, _FLEET])).analysis.estimate
    together = pool([near, far], np.log([0.08, 0.16]), 1).estimate
    # votes lie on a grid
    assert together.gsd_m_per_px == pytest.approx(alone.gsd_m_per_px, rel=1e-3)
    in_the_other = pool([near, far], np.log([0.08, 0.16]), 0).estimate
    assert in_the_other.gsd_m_per_px is not None
    assert together.gsd_m_per_px == pytest.approx(2 * in_the_other.gsd_m_per_px, rel=1e-3)


def test_one_photograph_says_what_it_says_alone() -> None:
    one = _photograph(_FLEET)
    assert pool([one], [0.3], 0).estimate == one.analysis.estimate


def test_looks_at_vehicles_stay_with_their_boxes() -> None:
    first = Detections(
        np.full((3, 5), 1.0),
        np.array([0.9, 0.5, 0.3]),
        appearance=Appearance(np.array([1.9, 1.5]), np.array([0.1, 0.2]), np.array([9.0, 5.0])),
    )
    second = Detections(
        np.full((2, 5), 2.0),
        np.array([0.8, 0.4]),
        appearance=Appearance(np.array([1.8, 1.4]), np.array([0.3, 0.4]), np.array([8.0, 4.0])),
    )
    both = pooled_detections([first, second], np.zeros(2))
    assert both.appearance is not None
    assert list(both.appearance.logits) == [9.0, 8.0, 5.0, 4.0]
    assert list(both.appearance.log_lengths) == [1.9, 1.8, 1.5, 1.4]
    assert list(both.scores) == [0.9, 0.8, 0.5, 0.4, 0.3]
    assert list(both.boxes[:, 0]) == [1, 2, 1, 2, 1]


def test_boxes_found_in_a_reduced_copy_keep_their_length_in_it() -> None:
    seen = Detections(np.full((1, 5), 40.0), np.array([0.9]), reductions=np.array([0.5]))
    (pooled,) = pooled_detections([seen], [np.log(2.0)]).boxes
    scales = pooled_detections([seen], [np.log(2.0)]).reductions
    assert scales is not None
    assert pooled[2] * scales[0] == pytest.approx(20.0)


@pytest.mark.parametrize(("gain", "narrower"), [(0.0, 1.0), (0.5, 2.0), (1.0, 4.0)])
def test_rulers_that_err_alike_gain_less_by_number(gain: float, narrower: float) -> None:
    one = lognormal(0.1, 0.2)
    low, high = credible_interval(one)
    all_low, all_high = credible_interval(combined_density([one] * 16, gain))
    assert np.log(high / low) / np.log(all_high / all_low) == pytest.approx(narrower, rel=0.02)


def test_a_witness_of_the_flight_is_heard() -> None:
    photographs = [_photograph(_FLEET), _photograph(_FLEET)]
    extra = point_witness("positions", 0.17, log_sd=0.05, chance_wrong=0.05, said="{}", n=3)
    pooled = pool(photographs, np.zeros(2), 0, [extra])
    assert pooled.witnesses[1:] == (extra,)
    assert [ruler.kind for ruler in pooled.estimate.rulers] == ["vehicles", "positions"]


def test_a_prior_counts_once_per_place() -> None:
    prior = prior_witness("scene_scale", lognormal(0.13, 0.2), power=0.7, n=24)
    pooled = _pooled_witness("scene_scale", [(prior, 0.0)] * 10)
    assert prior.interval is not None
    assert pooled.interval == pytest.approx(prior.interval)
    assert (pooled.sets_scale, pooled.chance_wrong) == (False, prior.chance_wrong)


def test_photographs_of_one_take_off_share_its_error() -> None:
    height = Shared("height above take-off", 0.12)
    each = point_witness("camera", 0.1, log_sd=0.02, chance_wrong=0.05, said="{}", shared=[height])
    pooled = _pooled_witness("camera", [(each, 0.0), (each, 0.05)])
    assert (pooled.shared, pooled.chance_wrong) == ((height,), 0.05)
    assert pooled.gsd_m_per_px == pytest.approx(0.1 * np.exp(-0.025), rel=0.01)


def test_a_stretch_of_the_camera_is_that_of_the_photographs_with_the_vehicles() -> None:
    few = Detections(np.full((1, 5), 40.0), np.full(1, 0.9), stretch=9.0)
    many = Detections(np.full((9, 5), 40.0), np.full(9, 0.9), stretch=0.0)
    assert pooled_detections([few, many], np.zeros(2)).stretch == pytest.approx(0.9)
    assert pooled_detections([NOT_SEARCHED, NOT_SEARCHED], np.zeros(2)).stretch is None


def test_two_stretched_photographs_are_as_doubtful_together_as_alone() -> None:
    view = _photograph(_FLEET).view
    searched = replace(view.detections, reductions=np.ones(len(_FLEET)), stretch=3.0)
    stored = StoredPhotograph(view.image, searched, 1.0)
    photographs = [Photograph.of(name, stored, view.card, view.options) for name in ("one", "two")]
    pooled = pool(photographs, np.zeros(2), 0).estimate
    for estimate in (photographs[0].analysis.estimate, pooled):
        assert (estimate.status, [each.code for each in estimate.warnings]) == (
            "low_confidence",
            ["stretched"],
        )


FLEET = 30.0 * (1 + 0.05 * np.linspace(-1, 1, 9) ** 3)


def _taken(time: str, model: str = "FC3170") -> ImageFacts:
    facts = facts_at(0.0, 0.0)
    assert facts.camera is not None
    return facts._replace(camera=replace(facts.camera, model=model, taken_at=time))


@pytest.mark.parametrize(
    ("facts", "numbers"),
    [
        (
            [
                _taken("2025:10:05 16:40:31"),
                _taken("2025:10:05 16:59:31"),
                _taken("2025:10:05 17:10:00"),
            ],
            [0, 0, 0],
        ),
        (
            [
                _taken("2025:10:05 16:40:31"),
                _taken("2025:10:05 17:40:31"),
                _taken("2025:10:05 16:41:00"),
            ],
            [0, 1, 0],
        ),
        ([_taken("2025:10:05 16:40:31"), _taken("2025:10:05 16:40:31", "FC220")], [0, 1]),
        ([_taken(""), _taken("2025:10:05 16:40:31"), _taken("yesterday")], [0, 0, 0]),
        ([ImageFacts(9, 9), ImageFacts(9, 9)], [0, 0]),
    ],
)
def test_a_pause_or_another_camera_begins_a_sortie(
    facts: list[ImageFacts], numbers: list[int]
) -> None:
    assert number_sorties(facts) == numbers


def _same_scale(*facts: ImageFacts) -> FlightEstimate:
    card = made_card(5.0)
    photographs = [
        Photograph.of(
            str(number), StoredPhotograph(each, vehicles_of(FLEET), 1.0), card, ScaleOptions()
        )
        for number, each in enumerate(facts)
    ]
    return conclude_flight(
        photographs, [single_component(range(len(facts)), 0)], card, same_scale=True
    )


def test_one_scale_for_two_sorties_is_warned_of() -> None:
    two = _same_scale(_taken("2025:10:05 16:40:31"), _taken("2025:10:05 18:40:31"))
    assert [each.sortie for each in two.photographs] == [0, 1]
    (warning,) = (each for each in two.warnings if each.code == "several_sorties")
    assert "2 sorties of 1 and 1 photographs" in warning.message
    one = _same_scale(_taken("2025:10:05 16:40:31"), _taken("2025:10:05 16:40:33"))
    assert "several_sorties" not in {each.code for each in one.warnings}


def test_tiles_and_skipped_candidates_add_up() -> None:
    first = Detections(
        np.zeros((0, 5)), np.zeros(0), n_tiles=3, n_capped_tiles=1, n_tiles_total=20, n_skipped=5
    )
    second = Detections(
        np.zeros((0, 5)), np.zeros(0), n_tiles=4, n_capped_tiles=0, n_tiles_total=30, n_skipped=2
    )
    pooled = pooled_detections([first, second], np.zeros(2))
    assert (pooled.n_tiles, pooled.n_capped_tiles, pooled.n_tiles_total, pooled.n_skipped) == (
        7,
        1,
        50,
        7,
    )
