from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import made_card
from tests.flight.ground import facts_at, features_of, ground, photograph_of, vehicles_of
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera_tilt import CameraTilt
from vehanchor_flight.estimate import reduced_picture, without_copies
from vehanchor_flight.features import Features
from vehanchor_flight.graph import Link, Unary, solve
from vehanchor_flight.linking import link_photographs
from vehanchor_flight.matching import match
from vehanchor_flight.pairs import candidate_pairs
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import Failure, conclude_flight

WORLD = ground(seed=5)
OTHER = ground(seed=6)
GROUND_M_PER_PX = 0.1
# pixels of the ground: a modal length of 5 m
FLEET = 50.0 * (1 + 0.05 * np.linspace(-1, 1, 12) ** 3)
STATIONS = [
    (400, 400, 0, 1.0),
    (560, 420, 140, 1.25),
    (700, 560, 30, 0.8),
    (640, 760, 250, 1.0),
    (460, 800, 70, 1.5),
]


@pytest.fixture(scope="module")
def seen() -> list[Features]:
    """Five photographs that overlap in a chain, and two of another place."""
    own = [photograph_of(WORLD, x, y, turn_deg=turn, scale=scale) for x, y, turn, scale in STATIONS]
    others = [
        photograph_of(OTHER, 500, 500),
        photograph_of(OTHER, 620, 560, turn_deg=90, scale=1.2),
    ]
    return [features_of(image) for image in (*own, *others)]


def _photograph(name: str, image: ImageFacts, lengths: NDArray[np.float64]) -> Photograph:
    return Photograph.of(
        name, StoredPhotograph(image, vehicles_of(lengths), 1.0), made_card(5.0), ScaleOptions()
    )


def _flight(*, with_cars: tuple[int, ...], placed: bool = False) -> list[Photograph]:
    flight = []
    scales = [*(scale for *_, scale in STATIONS), 1.0, 1.2]
    for number, scale in enumerate(scales):
        facts = ImageFacts(500, 500)
        if placed and number < len(STATIONS):
            x, y, *_ = STATIONS[number]
            facts = facts_at(x * GROUND_M_PER_PX, -y * GROUND_M_PER_PX)
        flight.append(
            _photograph(str(number), facts, FLEET / scale if number in with_cars else np.zeros(0))
        )
    return flight


@pytest.mark.parametrize(("turn_deg", "scale"), [(35, 1.3), (275, 0.7)])
def test_a_match_gives_the_ratio_of_the_scales_and_the_place(turn_deg: float, scale: float) -> None:
    first = features_of(photograph_of(WORLD, 600, 600))
    second = features_of(photograph_of(WORLD, 680, 560, turn_deg=turn_deg, scale=scale))
    found = match(first, second)
    assert found is not None
    assert np.exp(found.log_ratio) == pytest.approx(1 / scale, rel=0.02)
    assert abs(found.log_ratio + np.log(scale)) < 3 * found.log_sd
    turn = np.radians(turn_deg)
    expected = (
        np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ [-80, 40] / scale
        + 250
    )
    assert found.turn[:, :2] @ [250, 250] + found.turn[:, 2] == pytest.approx(expected, abs=3)


def test_photographs_of_other_places_do_not_match(seen: list[Features]) -> None:
    assert match(seen[0], seen[5]) is None
    nothing = features_of(np.full((200, 200, 3), 90, np.uint8))
    assert len(nothing) == 0
    assert match(seen[0], nothing) is None


def test_candidates_are_found_by_appearance_and_stay_few() -> None:
    stations = [(x, y) for y in range(300, 1000, 180) for x in range(300, 1000, 180)]
    order = np.random.default_rng(3).permutation(len(stations))
    seen = [
        features_of(photograph_of(WORLD, *stations[k], turn_deg=37.0 * k, side_px=400))
        for k in order
    ]
    pairs = set(candidate_pairs(seen))
    near = {
        (a, b) for a, b in combinations(range(len(order)), 2)
        if np.hypot(*np.subtract(stations[order[a]], stations[order[b]])) < 190
    }  # fmt: skip
    assert len(near & pairs) > 0.85 * len(near)
    assert len(pairs) <= 10 * len(seen)


def test_candidates_are_found_by_position() -> None:
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), 1.0)
    places = np.array(
        [[0, 0], [500, 0], [900, 0], [5, 0], [float("nan")] * 2, [505, 0], [910, 0]],
        dtype=np.float64,
    )
    assert {(0, 3), (1, 5), (2, 6)} <= set(candidate_pairs([nothing] * 7, places))


def test_photographs_without_a_car_hang_on_those_that_overlap(seen: list[Features]) -> None:
    flight = _flight(with_cars=(0,))
    components, links = link_photographs(flight, seen)
    assert [sorted(component.members) for component in components] == [[0, 1, 2, 3, 4], [5, 6]]
    record = conclude_flight(flight, components, made_card(5.0), same_scale=False, links=links)
    for photograph, (*_, scale) in zip(record.photographs, STATIONS, strict=False):
        assert photograph.gsd_m_per_px == pytest.approx(GROUND_M_PER_PX * scale, rel=0.03)
        assert photograph.gsd_ci95_low_m_per_px is not None
        assert photograph.gsd_ci95_high_m_per_px is not None
        assert (
            photograph.gsd_ci95_low_m_per_px
            < GROUND_M_PER_PX * scale
            < photograph.gsd_ci95_high_m_per_px
        )
    last = record.photographs[4].supported_by[0]
    assert (last.ruler, last.photograph) == ("vehicles", "0")
    assert [each.status for each in record.photographs[5:]] == ["no_scale", "no_scale"]
    assert record.status == "low_confidence"


def test_positions_are_a_ruler_where_there_is_no_car(seen: list[Features]) -> None:
    flight = _flight(with_cars=(), placed=True)
    ((component, *_), _) = link_photographs(flight, seen)
    (positions,) = component.extra
    _, _, _, scale = STATIONS[int(component.members[component.reference])]
    assert positions.kind == "positions"
    assert positions.gsd_m_per_px == pytest.approx(GROUND_M_PER_PX * scale, rel=0.03)
    assert positions.interval is not None
    assert positions.interval.low < GROUND_M_PER_PX * scale < positions.interval.high


def test_positions_of_another_flight_are_no_ruler(seen: list[Features]) -> None:
    flight = _flight(with_cars=(), placed=True)
    places = [(0, 0), (60, 10), (-20, 5), (10, 44), (35, -30)]
    for number, place in enumerate(places):
        flight[number] = _photograph(str(number), facts_at(*place), np.zeros(0))
    assert link_photographs(flight, seen)[0][0].extra == ()


def test_an_overlap_with_a_copy_of_the_ground_elsewhere_is_dropped() -> None:
    copied = WORLD.copy()
    copied[650:950, 1200:1500] = photograph_of(WORLD, 250, 800, scale=0.92, side_px=300)
    seen = [features_of(photograph_of(copied, x, 800)) for x in range(250, 1351, 157)]
    flight = [
        _photograph(str(number), ImageFacts(500, 500), np.zeros(0)) for number in range(len(seen))
    ]
    components, links = link_photographs(flight, seen)
    (component,) = components
    dropped = {
        (link.first, link.second): link.dropped for link in links if link.dropped is not None
    }
    assert "off the shift by the other overlaps" in dropped["0", "7"]
    assert all(
        (int(link.second) - int(link.first) > 3) == (link.dropped is not None) for link in links
    )
    assert np.exp(component.offsets) == pytest.approx(np.ones(len(seen)), abs=0.01)


CORNERS = np.array([(0.0, 0.0), (500.0, 0.0), (500.0, 500.0), (0.0, 500.0)])
TILT = CameraTilt(35.0, 0.0, focal_length_px=700.0, source="metadata")
NO_CARS = vehicles_of(np.zeros(0))


def _features_between(there: NDArray[np.float64]) -> Features:
    """The features of a photograph whose corners show these places of the ground."""
    move = cv2.getPerspectiveTransform(there.astype(np.float32), CORNERS.astype(np.float32))
    return features_of(np.asarray(cv2.warpPerspective(WORLD, move, (500, 500)), dtype=np.uint8))


def _tilted(name: str, facts: ImageFacts) -> Photograph:
    return Photograph.of(
        name,
        StoredPhotograph(facts, NO_CARS, detail_share=1.0, others=(), tilt=TILT),
        made_card(5.0),
        ScaleOptions(),
    )


def test_photographs_of_one_height_and_tilt_have_one_scale() -> None:
    plane = TILT.plane(ImageFacts(500, 500))
    seen = [
        _features_between(plane.from_above(CORNERS) + np.array([800.0, y]))
        for y in (900.0, 800.0, 700.0)
    ]
    flight = [_tilted(name, ImageFacts(500, 500)) for name in "012"]
    ((component,), _) = link_photographs(flight, seen)
    assert np.exp(component.offsets) == pytest.approx(np.ones(3), abs=0.02)


def test_positions_of_tilted_photographs_are_below_their_cameras() -> None:
    plane = TILT.plane(ImageFacts(500, 500))
    flight = []
    seen = []
    stood = []
    for number, heading_deg in enumerate((0.0, 50.0, 100.0)):
        heading = np.radians(heading_deg)
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        middle = np.array([800.0, 800.0 - 40.0 * number])
        seen.append(_features_between(plane.from_above(CORNERS) @ turn.T + middle))
        stood.append(turn @ plane.foot + middle)
        east_m, south_m = 0.1 * stood[-1]
        flight.append(_tilted(str(number), facts_at(east_m, -south_m)))
    assert np.linalg.norm(stood[1] - stood[0]) > 200
    (positions,) = link_photographs(flight, seen)[0][0].extra
    assert positions.gsd_m_per_px == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize(("tilt_deg", "doubted"), [(0.0, False), (35.0, True)])
def test_ratios_of_an_unknown_tilt_are_doubted_and_those_of_two_heights_are_not(
    tilt_deg: float, doubted: bool
) -> None:
    plane = CameraTilt(tilt_deg, 0.0, focal_length_px=500.0, source="metadata").plane(
        ImageFacts(500, 500)
    )
    flight = []
    seen = []
    for number in range(6):
        scale = 1.0 if doubted or number % 2 else 0.75
        seen.append(
            _features_between(
                plane.from_above(CORNERS) * scale + np.array([800.0, 1050.0 - 90.0 * number])
            )
        )
        flight.append(_photograph(str(number), ImageFacts(500, 500), np.zeros(0)))
    ((component,), _) = link_photographs(flight, seen)
    off = np.abs(component.offsets)
    assert off.max() > 0.15
    assert (component.log_sds > off / 2).all() if doubted else (component.log_sds < 0.1).all()


def _ring(
    scales: np.ndarray, rng: np.random.Generator, *, reach: int = 3, sd: float = 0.01
) -> list[Link]:
    n = len(scales)
    return [
        Link(
            i,
            (i + step) % n,
            log_ratio=float(scales[i] - scales[(i + step) % n] + rng.normal(0, sd)),
            log_sd=sd,
        )
        for step in range(1, reach + 1)
        for i in range(n)
    ]


def test_scales_follow_the_ratios_and_the_few_that_have_evidence() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 30)
    unaries = [
        Unary(float(truth[k] + rng.normal(0, 0.05)), 0.05) if k % 3 == 0 else None
        for k in range(30)
    ]
    solution = solve(30, _ring(truth, rng), unaries)
    (component,) = solution.components
    assert np.abs(component.log_scales - truth).max() < 0.05
    assert solution.used.all()
    differences = component.log_scales - component.log_scales[0] - (truth - truth[0])
    assert np.abs(differences).max() < 0.04
    assert (np.abs(differences)[1:] < 4 * component.sds_from(0)[1:]).all()


@pytest.mark.parametrize("ratio", [3.0, 1 / 3.0, 1.5])
def test_a_contradiction_in_a_loop_is_found_and_dropped(ratio: float) -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 12)
    links = _ring(truth, rng)
    links.append(Link(0, 6, log_ratio=float(truth[0] - truth[6] + np.log(ratio)), log_sd=0.01))
    solution = solve(12, links, [Unary(float(each), 0.1) for each in truth])
    assert list(np.flatnonzero(~solution.used)) == [len(links) - 1]
    assert solution.residuals[-1] == pytest.approx(np.log(ratio), abs=0.05)
    assert np.abs(solution.components[0].log_scales - truth).max() < 0.1


def test_a_photograph_whose_own_evidence_is_wrong_is_overruled() -> None:
    rng = np.random.default_rng(2)
    truth = np.full(10, np.log(0.1))
    unaries = [Unary(float(truth[k]), 0.1) for k in range(10)]
    unaries[4] = Unary(float(truth[4] + np.log(3)), 0.05)
    (component,) = solve(10, _ring(truth, rng), unaries).components
    assert np.abs(component.log_scales - truth).max() < 0.08


def test_a_bridge_that_contradicts_the_evidence_on_both_sides_is_no_bridge() -> None:
    rng = np.random.default_rng(3)
    truth = np.full(16, np.log(0.1))
    links = [
        *_ring(truth[:8], rng),
        *(
            each._replace(first=each.first + 8, second=each.second + 8)
            for each in _ring(truth[8:], rng)
        ),
    ]
    links.append(Link(0, 8, log_ratio=float(np.log(3.0)), log_sd=0.02))
    solution = solve(16, links, [Unary(float(each), 0.1) for each in truth])
    assert [len(component.members) for component in solution.components] == [8, 8]


def test_ratios_that_differ_by_more_than_they_say_widen_the_rest() -> None:
    rng = np.random.default_rng(4)
    truth = np.zeros(20)
    links = [link._replace(log_sd=0.01) for link in _ring(truth, rng, sd=0.04)]
    assert 2.5 < solve(20, links, [None] * 20).inflation < 5.5


def test_a_camera_that_looks_aside_does_not_bend_the_scales() -> None:
    rng = np.random.default_rng(5)
    columns = 6
    n = 36
    aside = rng.normal(0, 0.06, (n, 2))
    links = []
    for first in range(n):
        for step, at in ((1, (0.5, 0.0)), (columns, (0.0, 0.5)), (columns + 1, (0.5, 0.5))):
            second = first + step
            if second >= n or (at[0] and first % columns == columns - 1):
                continue
            back = (-at[0], -at[1])
            ratio = aside[first] @ at - aside[second] @ back + rng.normal(0, 0.005)
            links.append(
                Link(
                    first, second, log_ratio=float(ratio), log_sd=0.01, first_at=at, second_at=back
                )
            )
    (component,) = solve(n, links, [Unary(0.0, 0.3)] * n).components
    (plain,) = solve(
        n, [link._replace(first_at=(0, 0), second_at=(0, 0)) for link in links], [Unary(0, 0.3)] * n
    ).components
    assert np.std(component.log_scales) < 0.75 * np.std(plain.log_scales)
    off = component.log_scales - component.log_scales.mean()
    assert (np.abs(off) < 3.5 * component.sds_from(int(np.argmin(np.abs(off)))).max()).all()


SCENE = np.kron(
    np.random.default_rng(3).integers(0, 255, (30, 40, 3)), np.ones((20, 20, 1))
).astype(np.uint8)


def _reduced(name: str, step: int, scene: np.ndarray = SCENE) -> Photograph:
    with open_raster(np.ascontiguousarray(scene[::step, ::step])) as raster:
        facts = ImageFacts(raster.width_px, raster.height_px)
        stored = StoredPhotograph(
            facts, NO_CARS, detail_share=1.0, others=(), reduced=reduced_picture(raster)
        )
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def test_two_sizes_of_a_photograph_are_one() -> None:
    small = _reduced("s", 2)
    whole = _reduced("w", 1)
    other = _reduced("o", 2, SCENE[::-1])
    kept = without_copies([small, whole, other])
    assert kept[1:] == [whole, other]
    assert isinstance(kept[0], Failure)
    assert "smaller copy of 'w'" in str(kept[0].error)
