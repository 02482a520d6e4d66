"""The chip network: mirrored chips whose answers agree, and bodies that lie where the edges say."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from research.scenes import render_scene
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.chips import (
    CHIP_COLUMNS,
    CHIP_LENGTH_PX,
    CHIP_ROWS,
    KINDS,
    ChipAnswers,
    ChipNetwork,
    bodies,
    candidate_chips,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import chips_beside, resolve_model

if TYPE_CHECKING:
    from numpy.typing import NDArray


class _Edges(ChipNetwork):
    """A network that measures the lit rectangle of a chip; the far end and the far side are the less sure ones."""

    def __init__(self) -> None:
        pass

    def predict(self, chips: NDArray[np.float32]) -> list[NDArray[np.float64]]:
        n, edges = len(chips), []
        for chip in chips[:, 0]:
            across, along = np.nonzero(chip > 0.5)
            ends = np.array([along.min(), along.max() + 1]) - CHIP_COLUMNS / 2
            sides = np.array([across.min(), across.max() + 1]) - CHIP_ROWS / 2
            edges.append(np.concatenate([ends, sides]) / CHIP_LENGTH_PX)
        spread = np.tile(np.log([0.01, 0.03, 0.01, 0.03]), (n, 1))
        kinds = np.tile(np.arange(len(KINDS), dtype=float), (n, 1))
        return [np.zeros(n), kinds, np.array(edges), spread, np.full(n, 0.1), np.ones((n, 2)), np.zeros((n, 2))]


def _painted(body: NDArray[np.float64]) -> NDArray[np.uint8]:
    image = np.zeros((220, 240, 3), np.uint8)
    corners = np.round((box_corners(body[None])[0] - 0.5) * 256).astype(np.int32)
    cv2.fillPoly(image, [corners], (255, 255, 255), cv2.LINE_AA, 8)
    return image


def _answers(image: NDArray[np.uint8], candidate: NDArray[np.float64], views: int = 4) -> ChipAnswers:
    with open_raster(image) as raster:
        return _Edges().answers(candidate_chips(raster, candidate), views=views)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.4])
def test_a_body_lies_where_its_edges_are(angle: float) -> None:
    body = np.array([121.0, 108.0, 60.0, 26.0, angle])
    candidate = np.array([[118.0, 110.0, 66.0, 32.0, angle]])
    found = bodies(candidate, _answers(_painted(body), candidate)._replace(turn=np.zeros(1)))
    np.testing.assert_allclose(box_corners(found), box_corners(body[None]), atol=2.0)  # a pixel of the chip


def test_mirrored_chips_agree_on_edges_and_share_their_spreads() -> None:
    candidate = np.array([[118.0, 110.0, 66.0, 32.0, 0.0]])
    image = _painted(np.array([124.0, 106.0, 60.0, 26.0, 0.0]))
    one, four = _answers(image, candidate, 1), _answers(image, candidate)
    np.testing.assert_allclose(four.edges, one.edges, atol=0.03)
    np.testing.assert_allclose(one.edge_sd, [[0.01, 0.03, 0.01, 0.03]])
    np.testing.assert_allclose(four.edge_sd, 0.02)
    assert four.turn[0] == pytest.approx(0)
    assert four.kinds.sum() == pytest.approx(1)


def test_edges_that_cross_still_give_a_body() -> None:
    crossed = ChipAnswers(
        np.zeros(1), np.zeros((1, len(KINDS))), np.array([[0.4, -0.4, 0.2, -0.2]]), np.full((1, 4), 0.1),
        np.zeros(1), np.zeros((1, 2)), np.ones((1, 2)),
    )  # fmt: skip
    _, _, length, width, _ = bodies(np.array([[50.0, 50.0, 40.0, 18.0, 0.0]]), crossed)[0]
    assert length > width > 0
    assert np.isfinite(crossed.log_size_sd).all()


def test_the_trained_one_measures_rendered_cars_in_boxes_that_are_too_large() -> None:
    path = chips_beside(resolve_model())
    assert path is not None
    network = ChipNetwork(path, runtime=Runtime(threads=1))
    scene = render_scene(0.1, width_px=640, height_px=640, seed=4, layout="urban")
    cars = [car for car in scene.vehicles if car.kind == "small-vehicle" and not car.difficult]
    truth = np.array([[car.x_px, car.y_px, car.length_px, car.width_px, car.angle_rad] for car in cars])
    with open_raster(scene.image) as raster:
        fitting, large = (network.answers(candidate_chips(raster, truth * (1, 1, k, k, 1))) for k in (1.08, 2.2))
    assert np.median(fitting.logit) > 0 > np.median(large.logit)
    errors = np.log(bodies(truth * (1, 1, 1.08, 1.08, 1), fitting)[:, 2:4] / truth[:, 2:4])
    assert np.abs(np.median(errors, axis=0)).max() < 0.05
