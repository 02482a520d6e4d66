"""The chip network: its answers for candidates, and their use in a search and an estimate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from tests.models import BODIES, blank_image, paint_vehicles, write_chip_network, write_detector
from vehanchor import analyse_scale
from vehanchor.analysis import pipeline
from vehanchor.detection.chips import (
    CHIP_COLUMNS,
    CHIP_LENGTH_PX,
    CHIP_ROWS,
    KINDS,
    ChipAnswers,
    ChipNetwork,
    bodies,
    body_end_tones,
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

Painted: TypeAlias = tuple[NDArray[np.uint8], NDArray[np.float64]]
"""A picture, and the boxes of its vehicles."""

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
    """A black picture with a red square of 8 px."""
    pixels = np.zeros((200, 220, 3), np.uint8)
    pixels[y - 4 : y + 4, x - 4 : x + 4, 0] = 255
    return pixels


def _answers(
    network: ChipNetwork, pixels: NDArray[np.uint8], boxes: NDArray[np.float64]
) -> ChipAnswers:
    with open_raster(pixels) as raster:
        return network.answers(candidate_chips(raster, boxes))


def _made_answers(n: int, **numbers: Any) -> ChipAnswers:
    """Answers for cars of 4.3 m by 1.72 m that fill their boxes."""
    answers = ChipAnswers(
        logit=np.full(n, 3.0),
        kinds=np.full((n, 10), 0.1),
        edges=np.tile([-0.5, 0.5, -0.2, 0.2], (n, 1)),
        edge_sd=np.full((n, 4), 0.02),
        turn=np.zeros(n),
        log_metres=np.tile(np.log([4.3, 1.72]), (n, 1)),
        metres_sd=np.full((n, 2), 0.07),
        drawn=np.full(n, -20.0),
    )
    return answers._replace(**numbers)


# --- Answers


@pytest.mark.parametrize("angle", [0.0, 0.9, 2.2])
def test_mirrored_chips_agree_on_where_the_body_lies(tmp_path: Path, angle: float) -> None:
    network = ChipNetwork(write_chip_network(tmp_path / "m.onnx"), runtime=Runtime(threads=1))
    candidate = np.array([[100.0, 90.0, CHIP_LENGTH_PX, 14.0, angle]])
    answers = _answers(network, _square(106, 86), candidate)
    x, y, length, width, _ = bodies(candidate, answers)[0]
    assert (x, y) == pytest.approx((106, 86), abs=0.3)
    assert (length, width) == pytest.approx((CHIP_LENGTH_PX, 0.4 * CHIP_LENGTH_PX), rel=0.01)


def test_a_body_lies_between_its_edges() -> None:
    candidate = np.array([[50.0, 40.0, 20.0, 9.0, 0.0]])
    (body,) = bodies(candidate, _made_answers(1, edges=np.array([[-0.4, 0.5, -0.1, 0.2]])))
    assert body == pytest.approx([51.0, 41.0, 18.0, 6.0, 0.0])


def test_the_tones_of_both_ends_are_those_of_their_pixels() -> None:
    # White in front, black at the back, grey beside the body.
    chips = np.full((1, CHIP_ROWS, CHIP_COLUMNS, 3), 120, np.uint8)
    middle = CHIP_COLUMNS // 2
    chips[:, 26:38, :middle] = 0
    chips[:, 26:38, middle:] = 255
    tones = body_end_tones(chips, _made_answers(1))
    assert tones[0, :, 0] == pytest.approx([0.0, 255.0])


def test_vans_and_lorries_are_work_vehicles() -> None:
    work = [kind for k, kind in enumerate(KINDS) if _work_chance(k) == 1.0]
    assert work == ["van", "lorry", "trailer", "other"]


def _work_chance(kind: int) -> float:
    """Chance of a work vehicle for a certain kind."""
    (chance,) = _made_answers(1, kinds=np.eye(len(KINDS))[[kind]]).work_chances
    return float(chance)


_CAR = np.array([[500.0, 400.0, 43.0, 20.0, 0.0]])
"""Box of a car of 43 px in the middle of an image."""

_WIDER = _made_answers(1, edges=np.array([[-0.5, 0.5, -0.22, 0.22]]))
"""Answers for this car whose width suggests 0.091 m/px, and whose length 0.1 m/px."""


def _gsd(answers: ChipAnswers) -> float:
    """GSD of the car of 43 px by its appearance."""
    appearance = read_appearance(_CAR, answers, _SIZE_PX)
    return float(np.exp(appearance.log_lengths[0]) / 43)


def test_the_appearance_gives_a_length_in_metres() -> None:
    appearance = read_appearance(_CAR, _made_answers(1), _SIZE_PX)
    assert appearance.log_lengths == pytest.approx(np.log(4.3))


def test_the_appearance_combines_length_and_width() -> None:
    assert 0.091 < _gsd(_WIDER) < 0.1


def test_the_better_known_side_counts_more() -> None:
    unsure_width = _WIDER._replace(edge_sd=np.array([[0.02, 0.02, 0.2, 0.2]]))
    assert _gsd(_WIDER) < _gsd(unsure_width) < 0.1
    plain = read_appearance(_CAR, _made_answers(1), _SIZE_PX)
    assert read_appearance(_CAR, unsure_width, _SIZE_PX).log_sds > plain.log_sds


def test_a_car_whose_length_the_border_cuts_counts_by_its_width() -> None:
    half = _made_answers(1, edges=np.array([[-0.25, 0.25, -0.2, 0.2]]))
    cut = read_appearance(np.array([[8.0, 400.0, 43.0, 20.0, 0.0]]), half, _SIZE_PX)
    assert np.exp(cut.log_lengths) / (43 * 0.5) == pytest.approx(0.1, rel=0.01)
    assert 0.05 < cut.log_sds < 0.2


def test_a_car_whose_width_the_border_cuts_counts_by_its_length() -> None:
    cut = read_appearance(np.array([[500.0, 4.0, 43.0, 20.0, 0.0]]), _made_answers(1), _SIZE_PX)
    assert cut.log_lengths == pytest.approx(np.log(4.3), rel=0.01)


# --- Files


def test_a_network_without_an_output_is_refused(tmp_path: Path) -> None:
    path = write_chip_network(tmp_path / "m.onnx", without="turn")
    with pytest.raises(ModelContractError, match=r"expected chips \[n, 3, 64, 96\]"):
        ChipNetwork(path)


def test_answers_that_are_not_numbers_are_refused(tmp_path: Path) -> None:
    network = ChipNetwork(write_chip_network(tmp_path / "m.onnx", gain=np.nan))
    with pytest.raises(ModelContractError, match="does not give numbers"):
        _answers(network, _square(9, 9), np.ones((1, 5)))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelNotFoundError):
        ChipNetwork(tmp_path / "none.onnx")


def test_a_detector_finds_the_chip_network_beside_it(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    assert load_detector(path).chips is None
    network = write_chip_network(path)
    bodies_there = load_detector(path).card.bodies
    assert bodies_there is not None
    assert bodies_there.model_dump() == BODIES
    network.unlink()
    assert load_detector(path).chips is None


def test_a_chip_network_changes_the_checksum(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    before = networks_sha256(load_detector(path).card)
    write_chip_network(path)
    assert networks_sha256(load_detector(path).card) != before


def test_a_changed_chip_network_is_loaded_again(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    write_chip_network(path)
    before = load_detector(path).card.bodies
    changed = json.dumps({**BODIES, "reference_length_m": 4.2})
    write_chip_network(path, metadata={"vehanchor.bodies": changed})
    assert load_detector(path).card.bodies != before


# --- The bundled network


@pytest.fixture(scope="module")
def rendered() -> Painted:
    """A rendered street scene, and the boxes of its cars."""
    scene = render_scene(0.08, width_px=700, height_px=700, seed=4, layout="urban")
    cars = [car for car in scene.vehicles if car.kind == "small-vehicle" and not car.difficult]
    boxes = [[car.x_px, car.y_px, car.length_px, car.width_px, car.angle_rad] for car in cars]
    assert len(boxes) > 10
    return scene.image, np.array(boxes)


@pytest.mark.slow
def test_the_bundled_network_prefers_fitting_boxes_to_large_ones(
    bundled: ChipNetwork, rendered: Painted
) -> None:
    image, boxes = rendered
    fitting = _answers(bundled, image, boxes)
    large = _answers(bundled, image, boxes * (1, 1, 2, 2, 1))
    assert np.median(fitting.logit) > 0 > np.median(large.logit)


def _median_log_errors(
    measured: NDArray[np.float64], true: NDArray[np.float64]
) -> tuple[float, float]:
    """Compute the median errors of the logs of length and width."""
    errors = np.abs(np.log(measured[:, 2:4] / true[:, 2:4]))
    length_error, width_error = np.median(errors, axis=0)
    return float(length_error), float(width_error)


@pytest.mark.slow
def test_the_bundled_network_measures_rendered_cars(
    bundled: ChipNetwork, rendered: Painted
) -> None:
    image, boxes = rendered
    fitting = _answers(bundled, image, boxes)
    by_fitting = bodies(boxes * (1, 1, 1.15, 1.2, 1), fitting)
    length_error, _ = _median_log_errors(by_fitting, boxes)
    assert length_error < 0.25

    larger = boxes * (1, 1, 1.15, 1.15, 1)
    measured = bodies(larger, _answers(bundled, image, larger))
    length_error, width_error = _median_log_errors(measured, boxes)
    assert length_error < 0.06
    assert width_error < 0.08


# --- Search


def _searched(
    detector: Detector, pixels: NDArray[np.uint8], options: Search | None = None
) -> Detections:
    with open_raster(pixels) as raster:
        return ImageSearch(raster, detector, options).searched()


def test_drawn_things_are_no_vehicles(tmp_path: Path, four_vehicles: Painted) -> None:
    pixels, _ = four_vehicles
    found = []
    for drawn in (-20.0, 20.0):
        path = write_detector(tmp_path / f"m{drawn}.onnx", metadata=_PAINTED)
        write_chip_network(path, drawn=drawn)
        found.append(len(_searched(Detector(path), pixels).boxes))
    assert found[0] > 0
    assert found[1] == 0


_EDGES = (-0.45, 0.45, -0.18, 0.18)
"""Edges of bodies that are a tenth shorter than their boxes."""


@pytest.fixture(scope="module")
def four_vehicles() -> Painted:
    """A dark picture with two weak and two strong vehicles, every other one on bright ground."""
    pixels = blank_image(60 + 150 * 4, 200, 0)
    for k in (0, 2):
        pixels[:, 150 * k : 150 * (k + 1)] = 255
    boxes = [[80 + 150 * k, 99.5, 40, 20, 0.0] for k in range(4)]
    return pixels, paint_vehicles(pixels, boxes, scores=[0.3, 0.9, 0.9, 0.1])


@pytest.fixture(scope="module")
def with_chips(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A detector whose chip network prefers bright ground."""
    path = write_detector(tmp_path_factory.mktemp("model") / "m.onnx", metadata=_PAINTED)
    write_chip_network(path, gain=8.0, edges=_EDGES, metadata={"vehanchor.weights": "1,1,-3"})
    return load_detector(path)


def test_of_few_vehicles_weaker_candidates_are_examined(
    with_chips: Detector, four_vehicles: Painted
) -> None:
    detections = _searched(with_chips, four_vehicles[0])
    # A weak one on bright ground, and a strong one.
    assert sorted(detections.boxes[:, 0]) == pytest.approx([80, 380], abs=3)
    assert (np.diff(detections.scores) <= 0).all()


def test_boxes_are_replaced_by_those_of_bodies(
    with_chips: Detector, four_vehicles: Painted
) -> None:
    detections = _searched(with_chips, four_vehicles[0])
    assert detections.boxes[:, 2:4] == pytest.approx(np.tile([36.0, 14.4], (2, 1)), rel=0.01)
    assert detections.appearance is not None
    assert len(detections.appearance) == 2


def test_without_verification_the_detectors_boxes_are_used(
    with_chips: Detector, four_vehicles: Painted
) -> None:
    pixels, boxes = four_vehicles
    plain = _searched(with_chips, pixels, Search(verify=False))
    assert sorted(plain.boxes[:, 0]) == pytest.approx([230, 380])
    assert plain.boxes[:, 2] == pytest.approx(boxes[1:3, 2])
    assert plain.appearance is None


def test_of_many_vehicles_the_best_are_examined(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata=_PAINTED)
    write_chip_network(path, edges=_EDGES)
    image = blank_image(900, 700)
    boxes = [[40 + 60 * (k % 14), 40 + 60 * (k // 14), 30, 12, 0.4] for k in range(140)]
    paint_vehicles(image, boxes)
    detections = _searched(load_detector(path), image)
    assert len(detections.boxes) == 140
    assert detections.appearance is not None
    assert len(detections.appearance) == 64
    # The others get bodies of the same proportions.
    expected = np.tile([27.0, 10.8], (140, 1))
    np.testing.assert_allclose(detections.boxes[:, 2:4], expected, rtol=0.01)


# --- The reference length


def _car_park(levels: list[int], length: float = 30.0) -> NDArray[np.uint8]:
    """A picture of vehicles, each on ground of one grey level."""
    image = blank_image(90 + 70 * len(levels), 100, 100)
    boxes = []
    for k, level in enumerate(levels):
        image[:, 15 + 70 * k : 85 + 70 * k] = blank_image(70, 100, level)
        boxes.append([50 + 70 * k, 50, length * (1 + 0.01 * (k % 3)), 12, 0.4])
    paint_vehicles(image, boxes)
    return image


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    path = write_detector(tmp_path_factory.mktemp("model") / "m.onnx")
    write_chip_network(path, length_m=4.6, brightness=-0.2)
    return Detector(path)


def test_the_appearance_of_the_vehicles_moves_the_reference_length(model: Detector) -> None:
    lengths_m = []
    for level in (40, 235):
        estimate = analyse_scale(_car_park([level] * 12), detector=model).estimate
        details = estimate.details
        assert details.reference_source == "appearance"
        assert estimate.mode_length_px is not None
        assert details.reference_length_m is not None
        gsd = details.reference_length_m / estimate.mode_length_px
        assert estimate.rulers[0].gsd_m_per_px == gsd
        lengths_m.append(details.reference_length_m)
    assert lengths_m[1] < lengths_m[0] <= 4.6


def test_the_appearance_of_outliers_does_not_count(
    model: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Painted vehicles have equal pixels, as copies of one vehicle have.
    monkeypatch.setattr(pipeline, "without_copies", lambda _, detections: detections)
    image = _car_park([40] * 8)
    lorries = blank_image(image.shape[1], 100, 235)
    paint_vehicles(lorries, [[50 + 70 * k, 50, 65, 20, 0.0] for k in range(3)])
    alone = analyse_scale(image, detector=model).estimate
    together = analyse_scale(np.vstack([image, lorries]), detector=model).estimate
    assert together.details.n_detections == 11
    assert together.n_vehicles == 8
    assert together.details.reference_length_m == pytest.approx(
        alone.details.reference_length_m, abs=0.02
    )


def _reference(model: Detector, **options: Any) -> tuple[str | None, float]:
    """Source and metres of the reference length."""
    image = _car_park([40] * 6)
    details = analyse_scale(image, ScaleOptions.of(options), detector=model).estimate.details
    return details.reference_source, details.reference_length_m or 0.0


def test_a_region_moves_the_length_by_appearance_towards_its_own(model: Detector) -> None:
    free_source, free_m = _reference(model)
    source, length_m = _reference(model, region="europe")
    assert (free_source, source) == ("appearance", "region")
    assert 4.1 < length_m < free_m


def test_a_given_length_replaces_the_length_by_appearance(model: Detector) -> None:
    assert _reference(model, reference_length_m=4.7) == ("given", 4.7)
