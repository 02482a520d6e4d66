"""The chip network: what it says of candidates, and what a search and an estimate do with it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from tests.models import BODIES, blank_image, paint_vehicles, write_chip_network, write_detector
from vehanchor import analyse_scale
from vehanchor.detection.chips import (
    CHIP_LENGTH_PX,
    ChipAnswers,
    ChipNetwork,
    bodies,
    candidate_chips,
    read_appearance,
)
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector, load_detector, networks_sha256
from vehanchor.detection.search import ImageSearch
from vehanchor.errors import ModelContractError, ModelNotFoundError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import auxiliary_model, resolve_model
from vehanchor.options import ScaleOptions, Search

_PAINTED = {
    "vehanchor.length_range_px": "9,64",
    "vehanchor.search_scales": "1",
    "vehanchor.min_score": "0.5",
}
_SIZE_PX = 1000, 800


@pytest.fixture(scope="module")
def bundled() -> ChipNetwork:
    path = auxiliary_model(resolve_model(), "chips")
    assert path is not None
    return ChipNetwork(path, runtime=Runtime(threads=1))


def _square(x: int, y: int) -> NDArray[np.uint8]:
    pixels = np.zeros((200, 220, 3), np.uint8)
    pixels[y - 4 : y + 4, x - 4 : x + 4, 0] = 255
    return pixels


def _answers(
    network: ChipNetwork, pixels: NDArray[np.uint8], boxes: NDArray[np.float64]
) -> ChipAnswers:
    with open_raster(pixels) as raster:
        return network.answers(candidate_chips(raster, boxes))


def _said(n: int, **numbers: Any) -> ChipAnswers:
    """Answers for cars of 4.3 m by 1.72 m that fill their boxes."""
    said = {
        "logit": np.full(n, 3.0),
        "kinds": np.full((n, 10), 0.1),
        "edges": np.tile([-0.5, 0.5, -0.2, 0.2], (n, 1)),
        "edge_sd": np.full((n, 4), 0.02),
        "turn": np.zeros(n),
        "log_metres": np.tile(np.log([4.3, 1.72]), (n, 1)),
        "metres_sd": np.full((n, 2), 0.07),
    }
    return ChipAnswers(**{**said, **numbers})


@pytest.mark.parametrize("angle", [0.0, 0.9, 2.2])
def test_mirrored_chips_agree_on_where_the_body_lies(tmp_path: Path, angle: float) -> None:
    network = ChipNetwork(write_chip_network(tmp_path / "m.onnx"), runtime=Runtime(threads=1))
    candidate = np.array([[100.0, 90.0, CHIP_LENGTH_PX, 14.0, angle]])
    answers = _answers(network, _square(106, 86), candidate)
    x, y, length, width, _ = bodies(candidate, answers)[0]
    assert (x, y) == pytest.approx((106, 86), abs=0.3)
    assert (length, width) == pytest.approx((CHIP_LENGTH_PX, 0.4 * CHIP_LENGTH_PX), rel=0.01)


def test_a_body_lies_between_its_edges() -> None:
    (body,) = bodies(
        np.array([[50.0, 40.0, 20.0, 9.0, 0.0]]), _said(1, edges=np.array([[-0.4, 0.5, -0.1, 0.2]]))
    )
    assert body == pytest.approx([51.0, 41.0, 18.0, 6.0, 0.0])


def test_looks_compare_metres_with_the_better_known_sides() -> None:
    boxes = np.array([[500.0, 400.0, 43.0, 20.0, 0.0]])
    plain = read_appearance(boxes, _said(1), _SIZE_PX)
    assert plain.log_lengths == pytest.approx(np.log(4.3))
    # the sides say 0.091 m/px, the ends 0.1
    wider = _said(1, edges=np.array([[-0.5, 0.5, -0.22, 0.22]]))
    by_both = np.exp(read_appearance(boxes, wider, _SIZE_PX).log_lengths[0]) / 43
    assert 0.091 < by_both < 0.1
    unsure = wider._replace(edge_sd=np.array([[0.02, 0.02, 0.2, 0.2]]))
    assert by_both < np.exp(read_appearance(boxes, unsure, _SIZE_PX).log_lengths[0]) / 43 < 0.1
    assert read_appearance(boxes, unsure, _SIZE_PX).log_sds > plain.log_sds


def test_a_car_that_the_border_cuts_tells_the_scale_by_its_width() -> None:
    half = _said(1, edges=np.array([[-0.25, 0.25, -0.2, 0.2]]))
    cut = read_appearance(np.array([[8.0, 400.0, 43.0, 20.0, 0.0]]), half, _SIZE_PX)
    assert np.exp(cut.log_lengths) / (43 * 0.5) == pytest.approx(0.1, rel=0.01)
    assert 0.05 < cut.log_sds < 0.2
    across = read_appearance(np.array([[500.0, 4.0, 43.0, 20.0, 0.0]]), _said(1), _SIZE_PX)
    assert across.log_lengths == pytest.approx(np.log(4.3), rel=0.01)


def test_another_network_is_refused(tmp_path: Path) -> None:
    path = write_chip_network(tmp_path / "m.onnx", without="turn")
    with pytest.raises(ModelContractError, match=r"expected chips \[n, 3, 64, 96\]"):
        ChipNetwork(path)
    with pytest.raises(ModelContractError, match="does not give numbers"):
        _answers(
            ChipNetwork(write_chip_network(tmp_path / "m.onnx", gain=np.nan)),
            _square(9, 9),
            np.ones((1, 5)),
        )
    with pytest.raises(ModelNotFoundError):
        ChipNetwork(tmp_path / "none.onnx")


def test_a_chip_network_that_comes_changes_or_goes_is_noticed(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    assert load_detector(path).chips is None
    before = networks_sha256(load_detector(path).card)
    network = write_chip_network(path)
    bodies_there = load_detector(path).card.bodies
    assert bodies_there is not None
    assert bodies_there.model_dump() == BODIES
    assert networks_sha256(load_detector(path).card) != before
    write_chip_network(
        path, metadata={"vehanchor.bodies": json.dumps({**BODIES, "reference_length_m": 4.2})}
    )
    assert load_detector(path).card.bodies != bodies_there
    network.unlink()
    assert load_detector(path).chips is None


@pytest.mark.slow
def test_the_bundled_network_measures_rendered_cars(bundled: ChipNetwork) -> None:
    scene = render_scene(0.08, width_px=700, height_px=700, seed=4, layout="urban")
    cars = [car for car in scene.vehicles if car.kind == "small-vehicle" and not car.difficult]
    boxes = np.array(
        [[car.x_px, car.y_px, car.length_px, car.width_px, car.angle_rad] for car in cars]
    )
    fitting, large = (
        _answers(bundled, scene.image, boxes * (1, 1, size, size, 1)) for size in (1, 2)
    )
    assert len(boxes) > 10
    assert np.median(fitting.logit) > 0 > np.median(large.logit)
    assert (
        np.median(np.abs(np.log(bodies(boxes * (1, 1, 1.15, 1.2, 1), fitting)[:, 2] / boxes[:, 2])))
        < 0.25
    )
    moved = _answers(bundled, scene.image, boxes * (1, 1, 1.15, 1.15, 1))
    measured = bodies(boxes * (1, 1, 1.15, 1.15, 1), moved)
    assert np.median(np.abs(np.log(measured[:, 2] / boxes[:, 2]))) < 0.06
    assert np.median(np.abs(np.log(measured[:, 3] / boxes[:, 3]))) < 0.08


# --- Search
#
# ----------------------------------------------------------------------------------------------------------


def _found(
    detector: Detector, pixels: NDArray[np.uint8], options: Search | None = None
) -> Detections:
    with open_raster(pixels) as raster:
        return ImageSearch(raster, detector, options).searched()


def _scene(n: int, scores: list[float]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A dark picture with painted vehicles, every other one on bright ground."""
    pixels = blank_image(60 + 150 * n, 200, 0)
    for k in range(0, n, 2):
        pixels[:, 150 * k : 150 * (k + 1)] = 255
    return pixels, paint_vehicles(
        pixels, [[80 + 150 * k, 99.5, 40, 20, 0.0] for k in range(n)], scores=scores
    )


def test_few_vehicles_and_weaker_candidates_are_looked_at(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata=_PAINTED)
    edges = (-0.45, 0.45, -0.18, 0.18)
    write_chip_network(path, gain=8.0, edges=edges, metadata={"vehanchor.weights": "1,1,-3"})
    pixels, boxes = _scene(4, [0.3, 0.9, 0.9, 0.1])
    detector = load_detector(path)
    found = _found(detector, pixels)
    # a weak one on bright ground and a strong one
    assert sorted(found.boxes[:, 0]) == pytest.approx([80, 380], abs=3)
    assert found.boxes[:, 2:4] == pytest.approx(np.tile([36.0, 14.4], (2, 1)), rel=0.01)
    assert (np.diff(found.scores) <= 0).all()
    assert found.appearance is not None
    assert len(found.appearance) == 2
    plain = _found(detector, pixels, Search(verify=False))
    assert sorted(plain.boxes[:, 0]) == pytest.approx([230, 380])
    assert plain.boxes[:, 2] == pytest.approx(boxes[1:3, 2])
    assert plain.appearance is None


def test_of_many_vehicles_the_best_are_looked_at_and_the_others_follow(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata=_PAINTED)
    write_chip_network(path, edges=(-0.45, 0.45, -0.18, 0.18))
    image = blank_image(900, 700)
    paint_vehicles(
        image, [[40 + 60 * (k % 14), 40 + 60 * (k // 14), 30, 12, 0.4] for k in range(140)]
    )
    found = _found(load_detector(path), image)
    assert len(found.boxes) == 140
    assert found.appearance is not None
    assert len(found.appearance) == 64
    np.testing.assert_allclose(found.boxes[:, 2:4], np.tile([27.0, 10.8], (140, 1)), rtol=0.01)


# --- The reference length
# --------------------------------------------------------------------------------------------


def _car_park(levels: list[int], length: float = 30.0) -> NDArray[np.uint8]:
    """Vehicles on ground of a level."""
    image = blank_image(90 + 70 * len(levels), 100, 100)
    for k, level in enumerate(levels):
        image[:, 15 + 70 * k : 85 + 70 * k] = level
    paint_vehicles(
        image,
        [[50 + 70 * k, 50, length * (1 + 0.01 * (k % 3)), 12, 0.4] for k in range(len(levels))],
    )
    return image


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    path = write_detector(tmp_path_factory.mktemp("model") / "m.onnx")
    write_chip_network(path, length_m=4.6, brightness=-0.2)
    return Detector(path)


def test_the_looks_of_the_vehicles_move_the_reference_length(model: Detector) -> None:
    lengths_m = []
    for level in (40, 235):
        estimate = analyse_scale(_car_park([level] * 12), detector=model).estimate
        assert estimate.details.reference_source == "appearance"
        assert estimate.mode_length_px is not None
        assert estimate.details.reference_length_m is not None
        assert (
            estimate.rulers[0].gsd_m_per_px
            == estimate.details.reference_length_m / estimate.mode_length_px
        )
        lengths_m.append(estimate.details.reference_length_m)
    assert lengths_m[1] < lengths_m[0] <= 4.6


def test_only_vehicles_that_were_kept_have_a_say(model: Detector) -> None:
    image = _car_park([40] * 8)
    lorries = blank_image(image.shape[1], 100, 235)
    paint_vehicles(lorries, [[50 + 70 * k, 50, 65, 20, 0.0] for k in range(3)])
    alone = analyse_scale(image, detector=model).estimate
    together = analyse_scale(np.vstack([image, lorries]), detector=model)
    assert together.estimate.details.n_detections == 11
    assert together.estimate.n_vehicles == 8
    assert together.estimate.details.reference_length_m == pytest.approx(
        alone.details.reference_length_m, abs=0.02
    )


def test_a_region_moves_lengths_by_looks_towards_its_own_and_a_length_replaces_them(
    model: Detector,
) -> None:
    image = _car_park([40] * 6)
    lengths_m = []
    for options, source in (
        ({}, "appearance"),
        ({"region": "europe"}, "region"),
        ({"reference_length_m": 4.7}, "given"),
    ):
        details = analyse_scale(image, ScaleOptions.of(options), detector=model).estimate.details
        assert details.reference_source == source
        lengths_m.append(details.reference_length_m or 0.0)
    free, region, given = lengths_m
    assert 4.1 < region < free
    assert given == 4.7
