from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

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
from vehanchor_flight.copies import reduced_picture, without_copies
from vehanchor_flight.features import Features
from vehanchor_flight.graph import Link, Solution, Unary, solve
from vehanchor_flight.linking import link_photographs
from vehanchor_flight.matching import match
from vehanchor_flight.pairs import candidate_pairs
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.record import Failure, conclude_flight
from vehanchor_flight.records import FlightEstimate

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_flight.components import Component

WORLD = ground(seed=5)
OTHER = ground(seed=6)
GROUND_M_PER_PX = 0.1
# Lengths in pixels of the ground; the modal length is 5 m.
FLEET = 50.0 * (1 + 0.05 * np.linspace(-1, 1, 12) ** 3)
NO_CARS = vehicles_of(np.zeros(0))


class Station(NamedTuple):
    """Where a photograph was taken, in pixels of the ground; the scale is that of its pixels."""

    x: float
    y: float
    turn_deg: float
    scale: float


STATIONS = [
    Station(400, 400, 0, 1.0),
    Station(560, 420, 140, 1.25),
    Station(700, 560, 30, 0.8),
    Station(640, 760, 250, 1.0),
    Station(460, 800, 70, 1.5),
]
OTHER_STATIONS = [Station(500, 500, 0, 1.0), Station(620, 560, 90, 1.2)]


def _photographed(world: NDArray[np.uint8], station: Station) -> Features:
    image = photograph_of(
        world, station.x, station.y, turn_deg=station.turn_deg, scale=station.scale
    )
    return features_of(image)


@pytest.fixture(scope="module")
def features() -> list[Features]:
    """Find features in five photographs that overlap in a chain, and in two of another place."""
    own = [_photographed(WORLD, station) for station in STATIONS]
    others = [_photographed(OTHER, station) for station in OTHER_STATIONS]
    return own + others


def _photograph(name: str, image: ImageFacts, lengths: NDArray[np.float64]) -> Photograph:
    stored = StoredPhotograph(image, vehicles_of(lengths), 1.0)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def _empty_photographs(n: int) -> list[Photograph]:
    return [_photograph(str(k), ImageFacts(500, 500), np.zeros(0)) for k in range(n)]


def _flight(*, with_cars: tuple[int, ...] = ()) -> list[Photograph]:
    """Make the photographs of all stations, some of them with cars."""
    flight = []
    for number, station in enumerate(STATIONS + OTHER_STATIONS):
        lengths = FLEET / station.scale if number in with_cars else np.zeros(0)
        flight.append(_photograph(str(number), ImageFacts(500, 500), lengths))
    return flight


def _placed_flight(places_m: Sequence[tuple[float, float]]) -> list[Photograph]:
    """Make the photographs of all stations without cars, with positions for those on one ground."""
    flight = _flight()
    for number, (east_m, north_m) in enumerate(places_m):
        flight[number] = _photograph(str(number), facts_at(east_m, north_m), np.zeros(0))
    return flight


@pytest.mark.parametrize(("turn_deg", "scale"), [(35, 1.3), (275, 0.7)])
def test_a_match_gives_the_ratio_of_the_scales(turn_deg: float, scale: float) -> None:
    first = _photographed(WORLD, Station(600, 600, 0, 1.0))
    second = _photographed(WORLD, Station(680, 560, turn_deg, scale))
    matched = match(first, second)
    assert matched is not None
    assert np.exp(matched.log_ratio) == pytest.approx(1 / scale, rel=0.02)
    assert abs(matched.log_ratio + np.log(scale)) < 3 * matched.log_sd


@pytest.mark.parametrize(("turn_deg", "scale"), [(35, 1.3), (275, 0.7)])
def test_a_match_gives_the_place_of_the_overlap(turn_deg: float, scale: float) -> None:
    first = _photographed(WORLD, Station(600, 600, 0, 1.0))
    second = _photographed(WORLD, Station(680, 560, turn_deg, scale))
    matched = match(first, second)
    assert matched is not None
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    expected = rotation @ [-80, 40] / scale + 250
    middle_of_first = matched.turn[:, :2] @ [250, 250] + matched.turn[:, 2]
    assert middle_of_first == pytest.approx(expected, abs=3)


def test_bands_that_show_dark_what_others_show_bright_match() -> None:
    seen = photograph_of(WORLD, 600, 600, turn_deg=0, scale=1.0)
    moved = photograph_of(WORLD, 680, 560, turn_deg=35, scale=1.0)
    matched = match(features_of(seen), features_of(255 - moved))
    assert matched is not None
    assert matched.log_ratio == pytest.approx(0, abs=0.02)


def test_photographs_of_other_places_do_not_match(features: list[Features]) -> None:
    assert match(features[0], features[5]) is None


def test_a_photograph_without_features_does_not_match(features: list[Features]) -> None:
    nothing = features_of(np.full((200, 200, 3), 90, np.uint8))
    assert len(nothing) == 0
    assert match(features[0], nothing) is None


def test_candidates_are_found_by_appearance_and_stay_few() -> None:
    places = [(x, y) for y in range(300, 1000, 180) for x in range(300, 1000, 180)]
    order = np.random.default_rng(3).permutation(len(places))
    features = []
    for k in order:
        x, y = places[k]
        image = photograph_of(WORLD, x, y, turn_deg=37.0 * k, side_px=400)
        features.append(features_of(image))
    near = set()
    for first, second in combinations(range(len(order)), 2):
        step = np.subtract(places[order[first]], places[order[second]])
        if np.hypot(*step) < 190:
            near.add((first, second))
    pairs = set(candidate_pairs(features))
    assert len(near & pairs) > 0.85 * len(near)
    assert len(pairs) <= 10 * len(features)


def test_candidates_are_found_by_position() -> None:
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), 1.0)
    unknown = [np.nan, np.nan]
    places = [[0, 0], [500, 0], [900, 0], [5, 0], unknown, [505, 0], [910, 0]]
    positions = np.array(places, dtype=np.float64)
    assert {(0, 3), (1, 5), (2, 6)} <= set(candidate_pairs([nothing] * 7, positions))


@pytest.fixture(scope="module")
def one_with_cars(features: list[Features]) -> FlightEstimate:
    """Conclude a flight of which only the first photograph shows cars."""
    flight = _flight(with_cars=(0,))
    components, links = link_photographs(flight, features)
    return conclude_flight(flight, components, made_card(5.0), same_scale=False, links=links)


def test_photographs_that_overlap_are_one_component(features: list[Features]) -> None:
    components, _ = link_photographs(_flight(with_cars=(0,)), features)
    members = [sorted(component.members) for component in components]
    assert members == [[0, 1, 2, 3, 4], [5, 6]]


@pytest.mark.parametrize("number", range(5))
def test_a_photograph_has_the_scale_of_those_that_overlap(
    one_with_cars: FlightEstimate, number: int
) -> None:
    photograph = one_with_cars.photographs[number]
    truth = GROUND_M_PER_PX * STATIONS[number].scale
    assert photograph.gsd_m_per_px == pytest.approx(truth, rel=0.03)
    assert photograph.gsd_ci95_low_m_per_px is not None
    assert photograph.gsd_ci95_high_m_per_px is not None
    assert photograph.gsd_ci95_low_m_per_px < truth < photograph.gsd_ci95_high_m_per_px


def test_a_photograph_names_the_one_whose_cars_support_it(one_with_cars: FlightEstimate) -> None:
    support = one_with_cars.photographs[4].supported_by[0]
    assert support.ruler == "vehicles"
    assert support.photograph == "0"


def test_photographs_without_a_link_to_cars_have_no_scale(one_with_cars: FlightEstimate) -> None:
    others = one_with_cars.photographs[5:]
    assert [photograph.status for photograph in others] == ["no_scale", "no_scale"]
    assert one_with_cars.status == "low_confidence"


def test_positions_are_a_ruler_where_there_is_no_car(features: list[Features]) -> None:
    places_m = [(station.x * GROUND_M_PER_PX, -station.y * GROUND_M_PER_PX) for station in STATIONS]
    components, _ = link_photographs(_placed_flight(places_m), features)
    largest = components[0]
    (positions,) = largest.extra
    reference = STATIONS[int(largest.members[largest.reference])]
    truth = GROUND_M_PER_PX * reference.scale
    assert positions.kind == "positions"
    assert positions.gsd_m_per_px == pytest.approx(truth, rel=0.03)
    assert positions.interval is not None
    assert positions.interval.low < truth < positions.interval.high


def test_positions_of_another_flight_are_no_ruler(features: list[Features]) -> None:
    flight = _placed_flight([(0, 0), (60, 10), (-20, 5), (10, 44), (35, -30)])
    components, _ = link_photographs(flight, features)
    assert components[0].extra == ()


def test_an_overlap_with_a_copy_of_the_ground_is_dropped() -> None:
    copied = WORLD.copy()
    copied[650:950, 1200:1500] = photograph_of(WORLD, 250, 800, scale=0.92, side_px=300)
    features = [features_of(photograph_of(copied, x, 800)) for x in range(250, 1351, 157)]
    components, links = link_photographs(_empty_photographs(len(features)), features)
    for link in links:
        is_far = int(link.second) - int(link.first) > 3
        assert is_far == (link.dropped is not None)
    (to_copy,) = (link for link in links if (link.first, link.second) == ("0", "7"))
    assert to_copy.dropped is not None
    assert "its shift differs" in to_copy.dropped
    assert "from that of the other overlaps" in to_copy.dropped
    (component,) = components
    assert np.exp(component.offsets) == pytest.approx(np.ones(len(features)), abs=0.01)


CORNERS = np.array([(0.0, 0.0), (500.0, 0.0), (500.0, 500.0), (0.0, 500.0)])
TILT = CameraTilt(35.0, 0.0, focal_length_px=700.0, source="metadata")


def _features_between(corners_on_ground: NDArray[np.float64]) -> Features:
    """Find the features of a photograph whose corners show these places of the ground."""
    move = cv2.getPerspectiveTransform(
        corners_on_ground.astype(np.float32), CORNERS.astype(np.float32)
    )
    image = cv2.warpPerspective(WORLD, move, (500, 500))
    return features_of(np.asarray(image, dtype=np.uint8))


def _tilted(name: str, image: ImageFacts) -> Photograph:
    stored = StoredPhotograph(image, NO_CARS, detail_share=1.0, others=(), tilt=TILT)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def test_photographs_of_one_height_and_tilt_have_one_scale() -> None:
    footprint = TILT.plane(ImageFacts(500, 500)).from_above(CORNERS)
    middles = [(800.0, 900.0), (800.0, 800.0), (800.0, 700.0)]
    features = [_features_between(footprint + np.array(middle)) for middle in middles]
    flight = [_tilted(name, ImageFacts(500, 500)) for name in "012"]
    ((component,), _) = link_photographs(flight, features)
    assert np.exp(component.offsets) == pytest.approx(np.ones(3), abs=0.02)


def test_positions_of_tilted_photographs_are_below_their_cameras() -> None:
    plane = TILT.plane(ImageFacts(500, 500))
    flight = []
    features = []
    feet = []
    for number, heading_deg in enumerate((0.0, 50.0, 100.0)):
        heading = np.radians(heading_deg)
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        middle = np.array([800.0, 800.0 - 40.0 * number])
        features.append(_features_between(plane.from_above(CORNERS) @ turn.T + middle))
        foot = turn @ plane.foot + middle
        feet.append(foot)
        east_m, south_m = 0.1 * foot
        flight.append(_tilted(str(number), facts_at(east_m, -south_m)))
    # The feet are far from each other, although the pictures overlap.
    assert np.linalg.norm(feet[1] - feet[0]) > 200
    components, _ = link_photographs(flight, features)
    (positions,) = components[0].extra
    assert positions.gsd_m_per_px == pytest.approx(0.1, rel=0.05)


def _strip(tilt_deg: float, scales: Sequence[float]) -> Component:
    """Link photographs of a strip, of unknown tilt and from heights in these proportions."""
    tilt = CameraTilt(tilt_deg, 0.0, focal_length_px=500.0, source="metadata")
    footprint = tilt.plane(ImageFacts(500, 500)).from_above(CORNERS)
    features = []
    for number, scale in enumerate(scales):
        middle = np.array([800.0, 1050.0 - 90.0 * number])
        features.append(_features_between(footprint * scale + middle))
    (component,), _ = link_photographs(_empty_photographs(len(scales)), features)
    return component


def test_ratios_of_an_unknown_tilt_are_doubted() -> None:
    component = _strip(35.0, [1.0] * 6)
    errors = np.abs(component.offsets)
    assert errors.max() > 0.15
    assert (component.log_sds > errors / 2).all()


def test_ratios_of_two_heights_are_not_doubted() -> None:
    component = _strip(0.0, [0.75, 1.0] * 3)
    assert np.abs(component.offsets).max() > 0.15
    assert (component.log_sds < 0.1).all()


def _ring(
    scales: NDArray[np.float64], rng: np.random.Generator, *, reach: int = 3, sd: float = 0.01
) -> list[Link]:
    """Link each photograph of a ring with the next ones; the ratios have errors."""
    n = len(scales)
    links = []
    for step in range(1, reach + 1):
        for first in range(n):
            second = (first + step) % n
            ratio = scales[first] - scales[second] + rng.normal(0, sd)
            links.append(Link(first, second, log_ratio=float(ratio), log_sd=sd))
    return links


def _all_evident(truth: NDArray[np.float64], sd: float = 0.1) -> list[Unary | None]:
    return [Unary(float(log_scale), sd) for log_scale in truth]


class Solved(NamedTuple):
    """True log scales, and the solution."""

    truth: NDArray[np.float64]
    solution: Solution


@pytest.fixture(scope="module")
def third_evident() -> Solved:
    """Solve a ring of which every third photograph has evidence."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 30)
    unaries: list[Unary | None] = [None] * 30
    for k in range(0, 30, 3):
        unaries[k] = Unary(float(truth[k] + rng.normal(0, 0.05)), 0.05)
    return Solved(truth, solve(30, _ring(truth, rng), unaries))


def test_scales_follow_the_few_that_have_evidence(third_evident: Solved) -> None:
    (component,) = third_evident.solution.components
    assert np.abs(component.log_scales - third_evident.truth).max() < 0.05
    assert third_evident.solution.used.all()


def test_scales_follow_the_ratios(third_evident: Solved) -> None:
    (component,) = third_evident.solution.components
    true_offsets = third_evident.truth - third_evident.truth[0]
    errors = component.log_scales - component.log_scales[0] - true_offsets
    assert np.abs(errors).max() < 0.04
    assert (np.abs(errors)[1:] < 4 * component.sds_from(0)[1:]).all()


@pytest.mark.parametrize("ratio", [3.0, 1 / 3.0, 1.5])
def test_a_contradiction_in_a_loop_is_dropped(ratio: float) -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(np.log(0.05), np.log(0.15), 12)
    links = _ring(truth, rng)
    wrong_ratio = float(truth[0] - truth[6] + np.log(ratio))
    links.append(Link(0, 6, log_ratio=wrong_ratio, log_sd=0.01))
    solution = solve(12, links, _all_evident(truth))
    assert list(np.flatnonzero(~solution.used)) == [len(links) - 1]
    assert solution.residuals[-1] == pytest.approx(np.log(ratio), abs=0.05)
    assert np.abs(solution.components[0].log_scales - truth).max() < 0.1


def test_a_photograph_whose_own_evidence_is_wrong_is_overruled() -> None:
    rng = np.random.default_rng(2)
    truth = np.full(10, np.log(0.1))
    unaries = _all_evident(truth)
    unaries[4] = Unary(float(truth[4] + np.log(3)), 0.05)
    (component,) = solve(10, _ring(truth, rng), unaries).components
    assert np.abs(component.log_scales - truth).max() < 0.08


def test_a_bridge_that_contradicts_both_sides_is_dropped() -> None:
    rng = np.random.default_rng(3)
    truth = np.full(16, np.log(0.1))
    one_side = _ring(truth[:8], rng)
    other_side = [
        link._replace(first=link.first + 8, second=link.second + 8)
        for link in _ring(truth[8:], rng)
    ]
    bridge = Link(0, 8, log_ratio=float(np.log(3.0)), log_sd=0.02)
    solution = solve(16, [*one_side, *other_side, bridge], _all_evident(truth))
    assert [len(component.members) for component in solution.components] == [8, 8]


def test_ratios_that_scatter_more_than_they_state_widen_the_rest() -> None:
    rng = np.random.default_rng(4)
    truth = np.zeros(20)
    links = [link._replace(log_sd=0.01) for link in _ring(truth, rng, sd=0.04)]
    assert 2.5 < solve(20, links, [None] * 20).inflation < 5.5


N_COLUMNS = 6
N_CELLS = 36


@pytest.fixture(scope="module")
def tilted_block() -> list[Link]:
    """Link neighbours of a block whose photographs have one scale, and tilts of their own."""
    rng = np.random.default_rng(5)
    gradients = rng.normal(0, 0.06, (N_CELLS, 2))
    neighbours = {1: (0.5, 0.0), N_COLUMNS: (0.0, 0.5), N_COLUMNS + 1: (0.5, 0.5)}
    links = []
    for first in range(N_CELLS):
        for step, at in neighbours.items():
            second = first + step
            is_last_column = first % N_COLUMNS == N_COLUMNS - 1
            if second >= N_CELLS or (at[0] and is_last_column):
                continue
            back = (-at[0], -at[1])
            ratio = gradients[first] @ at - gradients[second] @ back + rng.normal(0, 0.005)
            link = Link(
                first, second, log_ratio=float(ratio), log_sd=0.01, first_at=at, second_at=back
            )
            links.append(link)
    return links


def test_tilts_bend_the_scales_less_with_gradients(tilted_block: list[Link]) -> None:
    centred = [link._replace(first_at=(0, 0), second_at=(0, 0)) for link in tilted_block]
    unaries = [Unary(0.0, 0.3)] * N_CELLS
    (component,) = solve(N_CELLS, tilted_block, unaries).components
    (plain,) = solve(N_CELLS, centred, unaries).components
    assert np.std(component.log_scales) < 0.75 * np.std(plain.log_scales)


def test_tilts_bend_the_scales_within_their_errors(tilted_block: list[Link]) -> None:
    (component,) = solve(N_CELLS, tilted_block, [Unary(0.0, 0.3)] * N_CELLS).components
    errors = np.abs(component.log_scales - component.log_scales.mean())
    most_exact = int(np.argmin(errors))
    assert (errors < 3.5 * component.sds_from(most_exact).max()).all()


CELLS = np.random.default_rng(3).integers(0, 255, (30, 40, 3))
SCENE = np.kron(CELLS, np.ones((20, 20, 1))).astype(np.uint8)


def _reduced(name: str, step: int, scene: NDArray[np.uint8] = SCENE) -> Photograph:
    with open_raster(np.ascontiguousarray(scene[::step, ::step])) as raster:
        image = ImageFacts(raster.width_px, raster.height_px)
        reduced = reduced_picture(raster)
    stored = StoredPhotograph(image, NO_CARS, detail_share=1.0, others=(), reduced=reduced)
    return Photograph.of(name, stored, made_card(5.0), ScaleOptions())


def test_two_sizes_of_a_photograph_are_one() -> None:
    small = _reduced("s", 2)
    whole = _reduced("w", 1)
    # Half a turn makes no mirror image; features match it.
    other = _reduced("o", 2, SCENE[::-1, ::-1])
    remaining = without_copies([small, whole, other])
    assert remaining[1:] == [whole, other]
    assert isinstance(remaining[0], Failure)
    assert "smaller copy of 'w'" in str(remaining[0].error)


TRANSPOSED = SCENE.swapaxes(0, 1)


@pytest.mark.parametrize("scene", [SCENE[::-1], SCENE[:, ::-1], TRANSPOSED, TRANSPOSED[::-1, ::-1]])
def test_a_mirror_image_of_a_photograph_is_a_copy(scene: NDArray[np.uint8]) -> None:
    whole = _reduced("w", 1)
    mirrored = _reduced("m", 1, scene)
    remaining = without_copies([whole, mirrored])
    assert remaining[0] is whole
    assert isinstance(remaining[1], Failure)
    assert "mirrored copy of 'w'" in str(remaining[1].error)


def test_even_ground_is_no_mirror_image_of_itself() -> None:
    even = np.full_like(SCENE, 90)
    first = _reduced("a", 1, even)
    second = _reduced("b", 1, even + 1)
    assert without_copies([first, second]) == [first, second]
