from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import vehanchor
from research.scenes import render_scene
from tests.analyses import found_witness
from tests.skill.courts.drawing import draw_court
from vehanchor.courts.find import Court, courts_among
from vehanchor.courts.network import Proposal, coarse_factors, load_court_network
from vehanchor.courts.templates import BASKETBALL, TENNIS, Pose, Template
from vehanchor.imagery.raster import Raster, StoredPixels, Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.rulers.courts import witness_of
from vehanchor.scale.density import Votes, blurred, vehicle_likelihood
from vehanchor.scale.posterior import Witness, answer


def _measured(
    image: Any, gsd: float, *, which: int = 0, degrees: float = 20.0, factor: int = 1
) -> Court | None:
    """Measure a court from a proposal with typical errors: some pixels, degrees and per cent."""
    middle = image.shape[0] / 2
    pose = Pose(middle + 6, middle - 5, math.radians(degrees + 7), 1.1 / gsd)
    proposal = Proposal(which, 0.9, pose=pose, factor=factor)
    with open_raster(image) as raster:
        courts = courts_among(raster, [proposal])
    return courts[0] if courts else None


# --- Measurement


_SIZES = [(0.3, 256, 2), (0.2, 256, 2), (0.1, 512, 4), (0.05, 1024, 8)]
"""GSD, side of the image, and factor at which a court was proposed."""


@pytest.mark.parametrize(("gsd", "side", "factor"), _SIZES)
@pytest.mark.parametrize("degrees", [0.0, 20.0, 135.0])
def test_a_tennis_court_is_measured_to_a_fraction_of_a_per_cent(
    gsd: float, side: int, factor: int, degrees: float
) -> None:
    image = draw_court(TENNIS, gsd, degrees=degrees, side_px=side)
    court = _measured(image, gsd, degrees=degrees, factor=factor)
    assert court is not None
    assert court.kind == "tennis"
    assert court.gsd_m_per_px == pytest.approx(gsd, rel=0.005)
    assert court.corners.mean(axis=0) == pytest.approx([side / 2, side / 2], abs=0.5)
    edges = court.corners - np.roll(court.corners, -1, axis=0)
    sides_m = np.hypot(*edges.T) * gsd
    assert sides_m == pytest.approx([23.77, 10.97, 23.77, 10.97], rel=0.01)


@pytest.mark.parametrize("template", BASKETBALL, ids=lambda template: template.kind)
def test_the_lines_of_a_basketball_court_show_its_rules(template: Template) -> None:
    court = _measured(draw_court(template, 0.1, side_px=512), 0.1, which=1, factor=4)
    assert court is not None
    assert court.kind == template.kind
    assert court.gsd_m_per_px == pytest.approx(0.1, rel=0.005)


def test_a_court_with_too_few_pixels_is_not_measured() -> None:
    assert _measured(draw_court(TENNIS, 0.36, side_px=160), 0.36) is not None
    assert _measured(draw_court(TENNIS, 0.44, side_px=160), 0.44) is None


def test_a_court_with_a_hidden_line_is_measured() -> None:
    court = _measured(draw_court(TENNIS, 0.25, missing=(8,)), 0.25, factor=2)
    assert court is not None
    assert court.gsd_m_per_px == pytest.approx(0.25, rel=0.005)


def test_an_outline_alone_is_not_a_court() -> None:
    image = draw_court(TENNIS, 0.25, missing=(2, 3, 6, 7, 8))
    assert _measured(image, 0.25, factor=2) is None


def test_basketball_lines_without_arcs_are_not_a_court() -> None:
    template = BASKETBALL[0]
    n_lines = len(template.lines)
    arcs = tuple(range(n_lines, n_lines + len(template.arcs)))
    image = draw_court(template, 0.15, side_px=384, missing=arcs)
    assert _measured(image, 0.15, which=1, factor=4) is None


def test_bays_of_a_car_park_are_not_a_court() -> None:
    image = np.full((256, 256, 3), 90, np.uint8)
    image[60:200, 20:240:9] = 220
    image[60:200:36, 20:240] = 220
    assert _measured(image, 0.3, degrees=0.0, factor=2) is None


def _seamed_roof(gsd: float, n_bands: int, size_m: tuple[float, float]) -> NDArray[np.uint8]:
    """Draw a roof with bright seams along it, its gables and its middle."""
    half_length = size_m[0] / 2
    half_width = size_m[1] / 2
    seams = np.linspace(-half_width, half_width, n_bands + 1)
    lines = [(-half_length, y, half_length, y) for y in seams]
    lines += [(x, -half_width, x, half_width) for x in (-half_length, 0.0, half_length)]
    return draw_court(replace(TENNIS, lines=np.array(lines)), gsd, side_px=304)


@pytest.mark.parametrize(("n_bands", "size_m"), [(8, (28.1, 12.8)), (8, (26.8, 12.6))])
def test_a_roof_with_seams_is_not_a_court(n_bands: int, size_m: tuple[float, float]) -> None:
    """It has lines wherever a court has one, and lines between these."""
    gsd = size_m[0] / 160
    image = _seamed_roof(gsd, n_bands, size_m)
    for factor in (1.0, 1.2):
        pose = Pose(152.0, 152.0, math.radians(25), factor * 160 / TENNIS.length_m)
        with open_raster(image) as raster:
            assert courts_among(raster, [Proposal(0, 0.9, pose=pose, factor=2)]) == []


def test_a_court_with_lines_of_another_game_is_measured() -> None:
    """Pickleball has its own side lines, which end before the strips behind the service lines."""
    pickleball = np.array([(-6.7, y, 6.7, y) for y in (-3.05, 3.05)])
    both = replace(TENNIS, lines=np.concatenate([TENNIS.lines, pickleball]))
    court = _measured(draw_court(both, 0.1, side_px=512), 0.1, factor=4)
    assert court is not None
    assert court.gsd_m_per_px == pytest.approx(0.1, rel=0.005)


def test_a_court_that_the_edge_cuts_is_not_measured() -> None:
    assert _measured(draw_court(TENNIS, 0.3)[:, 110:], 0.3, factor=2) is None


def test_the_lines_decide_and_not_the_networks_score() -> None:
    image = np.random.default_rng(3).integers(60, 120, (700, 700, 3)).astype(np.uint8)
    image[380:636, 380:636] = draw_court(TENNIS, 0.2)
    # Nine proposals have higher scores, and the angle of the true one is wrong.
    decoys = [
        Proposal(0, 0.9, pose=Pose(x, y, 0.3, 5.0), factor=4)
        for x in (120.0, 330.0, 560.0)
        for y in (80.0, 180.0, 280.0)
    ]
    true = Proposal(0, 0.3, pose=Pose(512.0, 504.0, 1.0, 5.6), factor=4)
    with open_raster(image) as raster:
        (court,) = courts_among(raster, [*decoys, true], n_sizes=4)
    assert court.gsd_m_per_px == pytest.approx(0.2, rel=0.005)


# --- Proposals


@pytest.mark.parametrize(("height", "width", "factors"), [(256, 256, [2, 4, 8]), (40, 4000, [])])
def test_a_small_image_is_searched_at_every_possible_size(
    height: int, width: int, factors: list[int]
) -> None:
    with open_raster(np.zeros((height, width, 3), np.uint8)) as raster:
        assert coarse_factors(raster, None) == factors


# --- Witness


def _court(gsd: float, kind: str = "tennis", *, score: float = 0.9, coverage: float = 1.0) -> Court:
    corners = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 5.0), (0.0, 5.0)])
    return Court(kind, corners, 23.77, 10.97, gsd, 0.001, score, coverage)


@pytest.fixture(scope="module")
def two_courts() -> Witness:
    return found_witness(witness_of([_court(0.3), _court(0.302)]))


def test_courts_are_one_witness(two_courts: Witness) -> None:
    assert (two_courts.kind, two_courts.n) == ("courts", 2)


def test_the_scale_of_courts_is_their_mean(two_courts: Witness) -> None:
    assert two_courts.gsd_m_per_px == pytest.approx(0.301, rel=1e-3)
    assert two_courts.interval is not None
    assert 0.295 < two_courts.interval.low < 0.301 < two_courts.interval.high < 0.307


def test_the_explanation_counts_the_courts(two_courts: Witness) -> None:
    assert two_courts.statement is not None
    assert two_courts.statement.startswith("2 tennis courts give 0.301 m/px")


def test_the_outline_of_a_court_is_a_mark(two_courts: Witness) -> None:
    outline = two_courts.marks[0]
    assert outline.closed
    assert len(outline.points) == 4


def test_two_sides_of_a_court_are_marks_with_their_lengths(two_courts: Witness) -> None:
    _, long_side, short_side = two_courts.marks[:3]
    assert (long_side.label, short_side.label) == ("23.77 m", "10.97 m")
    assert long_side.points == ((0.0, 0.0), (10.0, 0.0))


def test_the_explanation_names_the_rules_of_a_court() -> None:
    explanation = found_witness(witness_of([_court(0.3, "basketball_nba")])).statement
    assert explanation is not None
    assert "by the NBA's rules" in explanation


def test_a_court_that_contradicts_the_others_is_left_out() -> None:
    witness = found_witness(witness_of([_court(0.3), _court(0.301), _court(0.4)]))
    assert witness.n == 2
    assert witness.gsd_m_per_px == pytest.approx(0.3, rel=0.01)


def _chance_wrong(witness: Witness) -> float:
    """Compute the chance that a find is wrong, or no court."""
    (misfit,) = witness.shared
    return 1.0 - (1.0 - witness.chance_wrong) * (1.0 - misfit.chance_wrong)


def test_the_chance_of_a_court_follows_how_well_its_lines_fit() -> None:
    scores = (0.9, 0.8, 0.7, 0.6)
    witnesses = [found_witness(witness_of([_court(0.3, score=score)])) for score in scores]
    chances = [_chance_wrong(witness) for witness in witnesses]
    assert chances == sorted(chances)
    assert chances[0] < 0.05


def test_lines_that_hardly_fit_are_probably_not_a_court() -> None:
    """Lanes of a freeway were taken for a court with these numbers."""
    lanes = found_witness(witness_of([_court(0.3, score=0.594, coverage=0.698)]))
    assert _chance_wrong(lanes) > 0.5


def test_the_best_of_several_courts_gives_their_chance() -> None:
    poor = _court(0.301, score=0.6, coverage=0.7)
    alone = found_witness(witness_of([_court(0.3)]))
    together = found_witness(witness_of([_court(0.3), poor]))
    assert _chance_wrong(together) == _chance_wrong(alone)


def test_a_poor_court_does_not_outweigh_cars() -> None:
    lengths = 4.5 / 0.305 * np.exp(np.linspace(-0.1, 0.1, 9))
    votes = vehicle_likelihood(
        lengths, np.full(9, 0.95), lengths_m=4.5, votes=Votes(-13.76, 17.4), log_sds=0.12
    )
    cars = Witness("vehicles", 0.305, right=blurred(votes, 0.055), chance_wrong=0.01)
    lanes = found_witness(witness_of([_court(0.339, score=0.594, coverage=0.698)]))
    decided = answer([cars, lanes])
    assert decided is not None
    assert decided.interval.low < 0.305
    assert decided.gsd_m_per_px == pytest.approx(0.305, rel=0.06)


# --- Images


@pytest.fixture(scope="module")
def sports_ground() -> np.ndarray:
    return render_scene(0.25, width_px=384, height_px=384, seed=46, layout="sports").image


def test_the_record_names_the_courts_of_an_image(sports_ground: np.ndarray) -> None:
    estimate = vehanchor.estimate_gsd(sports_ground)
    assert estimate.rulers is not None
    (courts,) = (ruler for ruler in estimate.rulers if ruler.kind == "courts")
    assert courts.gsd_m_per_px == pytest.approx(0.25, rel=0.02)


def test_courts_are_searched_only_if_the_caller_wants_them(sports_ground: np.ndarray) -> None:
    estimate = vehanchor.estimate_gsd(sports_ground, rulers=("vehicles", "scene_scale"))
    assert not any(ruler.kind == "courts" for ruler in estimate.rulers or ())


class _WithOverviews(Raster):
    """A blank image with overviews that counts how it is read."""

    def __init__(self, side_px: int) -> None:
        super().__init__("blank", side_px, side_px)
        self.n_read = 0
        self.n_overviews = 0

    def _read_stored(self, window: Window) -> StoredPixels:
        self.n_read += 1
        return StoredPixels(np.zeros((window.height_px, window.width_px, 3), np.uint8), None)

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:
        assert factor == 8
        self.n_overviews += 1
        return np.zeros((window.height_px, window.width_px, 3), np.uint8)


@pytest.mark.parametrize(("side_px", "by_overviews"), [(3992, False), (4000, True)])
def test_courts_of_a_large_image_are_searched_on_its_overviews(
    side_px: int, by_overviews: bool
) -> None:
    network = load_court_network(Runtime(threads=1))
    raster = _WithOverviews(side_px)
    assert network.propose(raster, 8) == []
    assert (raster.n_overviews > 0) is by_overviews
    assert (raster.n_read == 0) is by_overviews
