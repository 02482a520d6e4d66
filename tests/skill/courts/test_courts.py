from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import vehanchor
from research.scenes import render_scene
from tests.analyses import told
from tests.skill.courts.drawing import draw_court
from vehanchor.courts.find import Court, courts_among
from vehanchor.courts.network import Proposal, coarse_factors, load_court_network
from vehanchor.courts.templates import BASKETBALL, TENNIS, Pose, Template
from vehanchor.imagery.raster import Raster, StoredPixels, Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.rulers.courts import witness_of


def _measured(
    image: Any, gsd: float, *, which: int = 0, degrees: float = 20.0, factor: int = 1
) -> Court | None:
    """What is measured from a proposal that is off by some pixels, degrees and per cent, as they come."""
    middle = image.shape[0] / 2
    pose = Pose(middle + 6, middle - 5, math.radians(degrees + 7), 1.1 / gsd)
    with open_raster(image) as raster:
        return next(
            iter(courts_among(raster, [Proposal(which, 0.9, pose=pose, factor=factor)])), None
        )


@pytest.mark.parametrize(
    ("gsd", "side", "factor"), [(0.3, 256, 2), (0.2, 256, 2), (0.1, 512, 4), (0.05, 1024, 8)]
)
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
    sides = np.hypot(*(court.corners - np.roll(court.corners, -1, axis=0)).T) * gsd
    assert sides == pytest.approx([23.77, 10.97, 23.77, 10.97], rel=0.01)


@pytest.mark.parametrize("template", BASKETBALL, ids=lambda each: each.kind)
def test_a_basketball_court_says_by_whose_rules_it_was_painted(template: Template) -> None:
    court = _measured(draw_court(template, 0.1, side_px=512), 0.1, which=1, factor=4)
    assert court is not None
    assert court.kind == template.kind
    assert court.gsd_m_per_px == pytest.approx(0.1, rel=0.005)


def test_a_court_of_fewer_pixels_than_its_lines_need_is_none() -> None:
    assert _measured(draw_court(TENNIS, 0.36, side_px=160), 0.36) is not None
    assert _measured(draw_court(TENNIS, 0.44, side_px=160), 0.44) is None


def test_a_line_hidden_or_worn_away_does_not_matter() -> None:
    court = _measured(draw_court(TENNIS, 0.25, missing=(8,)), 0.25, factor=2)
    assert court is not None
    assert court.gsd_m_per_px == pytest.approx(0.25, rel=0.005)


def test_an_outline_alone_is_no_court() -> None:
    assert _measured(draw_court(TENNIS, 0.25, missing=(2, 3, 6, 7, 8)), 0.25, factor=2) is None


def test_lines_of_basketball_without_its_arcs_are_no_court() -> None:
    template = BASKETBALL[0]
    arcs = tuple(range(len(template.lines), len(template.lines) + len(template.arcs)))
    assert (
        _measured(draw_court(template, 0.15, side_px=384, missing=arcs), 0.15, which=1, factor=4)
        is None
    )


def test_bays_of_a_car_park_are_no_court() -> None:
    image = np.full((256, 256, 3), 90, np.uint8)
    image[60:200, 20:240:9] = 220
    image[60:200:36, 20:240] = 220
    assert _measured(image, 0.3, degrees=0.0, factor=2) is None


def test_a_court_cut_by_the_edge_is_none() -> None:
    assert _measured(draw_court(TENNIS, 0.3)[:, 110:], 0.3, factor=2) is None


def test_what_has_the_lines_of_a_court_is_measured_first_however_unsure_the_network_is_of_it() -> (
    None
):
    image = np.random.default_rng(3).integers(60, 120, (700, 700, 3)).astype(np.uint8)
    image[380:636, 380:636] = draw_court(TENNIS, 0.2)
    decoys = [
        Proposal(0, 0.9, pose=Pose(x, y, 0.3, 5.0), factor=4)
        for x in (120.0, 330.0, 560.0)
        for y in (80.0, 180.0, 280.0)
    ]
    # nine are surer, and its angle is wrong
    court = Proposal(0, 0.3, pose=Pose(512.0, 504.0, 1.0, 5.6), factor=4)
    with open_raster(image) as raster:
        (found,) = courts_among(raster, [*decoys, court], n_sizes=4)
    assert found.gsd_m_per_px == pytest.approx(0.2, rel=0.005)


def test_a_small_image_is_searched_at_every_size_that_a_court_can_have_in_it() -> None:
    with open_raster(np.zeros((256, 256, 3), np.uint8)) as raster:
        assert coarse_factors(raster, None) == [2, 4, 8]
    with open_raster(np.zeros((40, 4000, 3), np.uint8)) as raster:
        assert coarse_factors(raster, None) == []


def _court(gsd: float, kind: str = "tennis", log_sd: float = 0.001) -> Court:
    corners = np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 5.0), (0.0, 5.0)])
    return Court(kind, corners, 23.77, 10.97, gsd, log_sd, 0.9)


def test_courts_are_a_witness_with_their_measured_sides() -> None:
    witness = told(witness_of([_court(0.3), _court(0.302)]))
    assert witness.gsd_m_per_px == pytest.approx(0.301, rel=1e-3)
    assert (witness.kind, witness.n) == ("courts", 2)
    assert witness.interval is not None
    assert 0.295 < witness.interval.low < 0.301 < witness.interval.high < 0.307
    assert witness.said is not None
    assert witness.said.startswith("2 tennis courts say 0.301 m/px")
    outline, long_side, short_side = witness.marks[:3]
    assert outline.closed
    assert len(outline.points) == 4
    assert (long_side.label, short_side.label) == ("23.77 m", "10.97 m")
    assert long_side.points == ((0.0, 0.0), (10.0, 0.0))


def test_a_court_says_by_whose_rules_it_is() -> None:
    said = told(witness_of([_court(0.3, "basketball_nba")])).said
    assert said is not None
    assert "by the NBA's rules" in said


def test_a_court_that_says_something_else_than_the_others_is_left_out() -> None:
    witness = told(witness_of([_court(0.3), _court(0.301), _court(0.4)]))
    assert witness.n == 2
    assert witness.gsd_m_per_px == pytest.approx(0.3, rel=0.01)


def test_a_court_is_found_in_an_image_and_named_in_the_record() -> None:
    scene = render_scene(0.25, width_px=384, height_px=384, seed=46, layout="sports")
    estimate = vehanchor.estimate_gsd(scene.image)
    assert estimate.rulers is not None
    (courts,) = (ruler for ruler in estimate.rulers if ruler.kind == "courts")
    assert courts.gsd_m_per_px == pytest.approx(0.25, rel=0.02)
    without = vehanchor.estimate_gsd(scene.image, rulers=("vehicles", "scene_scale"))
    assert not any(ruler.kind == "courts" for ruler in without.rulers or ())


class _WithOverviews(Raster):
    """A blank image that keeps copies, and counts who reads what."""

    def __init__(self, side_px: int) -> None:
        super().__init__("blank", side_px, side_px)
        self.n_read = self.n_overviews = 0

    def _read_stored(self, window: Window) -> StoredPixels:
        self.n_read += 1
        return StoredPixels(np.zeros((window.height_px, window.width_px, 3), np.uint8), None)

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:
        assert factor == 8
        self.n_overviews += 1
        return np.zeros((window.height_px, window.width_px, 3), np.uint8)


@pytest.mark.parametrize(("side_px", "by_overviews"), [(3992, False), (4000, True)])
def test_courts_of_a_large_image_are_looked_for_on_its_overviews(
    side_px: int, by_overviews: bool
) -> None:
    network = load_court_network(Runtime(threads=1))
    raster = _WithOverviews(side_px)
    assert network.propose(raster, 8) == []
    assert (raster.n_overviews > 0) is by_overviews
    assert (raster.n_read == 0) is by_overviews
