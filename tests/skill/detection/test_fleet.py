"""The network that tells fleets apart, and what an estimate does with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models import blank_image, paint_vehicles, write_detector, write_fleet_network, write_other_model
from vehanchor import analyse_scale
from vehanchor.detection.appearance import MAX_CHIPS, FleetLengths, chip, vehicle_chips
from vehanchor.detection.detector import Detector
from vehanchor.detection.fleet import FleetNetwork
from vehanchor.detection.search import search
from vehanchor.errors import ModelContractError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions

_LENGTHS = FleetLengths((-1.0, 1.0), (4.0, 5.0), 0.3, 2.0)


def _car_park(levels: list[int], length: float = 30.0) -> NDArray[np.uint8]:
    """Vehicles on ground of a level: the darker it is, the higher ``write_fleet_network``'s answers."""
    image = blank_image(90 + 70 * len(levels), 100, 100)
    for k, level in enumerate(levels):
        image[:, 15 + 70 * k : 85 + 70 * k] = level
    paint_vehicles(image, [[50 + 70 * k, 50, length * (1 + 0.01 * (k % 3)), 12, 0.4] for k in range(len(levels))])
    return image


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    path = write_detector(
        tmp_path_factory.mktemp("model") / "m.onnx", metadata={"vehanchor.region_lengths_m": '{"europe": 4.1}'}
    )
    write_fleet_network(path, _LENGTHS)
    return Detector(path)


def test_a_model_that_tells_fleets_apart_moves_the_reference_length(model: Detector) -> None:
    dark, light = (analyse_scale(_car_park([level] * 12), detector=model).estimate for level in (40, 235))
    assert dark.details.reference_source == light.details.reference_source == "appearance"
    short, long = light.details.reference_length_m or 0, dark.details.reference_length_m or 0
    assert 4.0 <= short < 4.3 < 4.7 < long <= 5.0
    assert dark.mode_length_px == light.mode_length_px
    for estimate in (dark, light):
        assert estimate.mode_length_px is not None
        assert estimate.rulers[0].gsd_m_per_px == (estimate.details.reference_length_m or 0) / estimate.mode_length_px


def test_only_vehicles_that_were_kept_have_a_say(model: Detector) -> None:
    image = _car_park([40] * 8)
    lorries = blank_image(image.shape[1], 100, 235)
    paint_vehicles(lorries, [[50 + 70 * k, 50, 65, 20, 0.0] for k in range(3)])
    alone = analyse_scale(image, detector=model).estimate
    together = analyse_scale(np.vstack([image, lorries]), detector=model)
    assert together.estimate.details.n_detections == 11
    assert together.estimate.n_vehicles == 8
    assert together.estimate.details.reference_length_m == pytest.approx(alone.details.reference_length_m, abs=0.02)


@pytest.mark.parametrize(
    ("options", "source", "length"),
    [
        ({"region": "europe"}, "region", 4.1),
        ({"reference_length_m": 4.7}, "given", 4.7),
    ],
)
def test_what_the_caller_says_comes_first(model: Detector, options: Any, source: str, length: float) -> None:
    estimate = analyse_scale(_car_park([40] * 6), ScaleOptions.of(options), detector=model).estimate
    assert (estimate.details.reference_source, estimate.details.reference_length_m) == (source, length)


def test_no_more_than_a_hundred_vehicles_are_asked(model: Detector) -> None:
    image = blank_image(900, 700)
    paint_vehicles(image, [[40 + 60 * (k % 14), 40 + 60 * (k // 14), 30, 12, 0.4] for k in range(140)])
    with open_raster(image) as raster:
        found = search(raster, model)
    assert len(found.boxes) == 140
    assert found.fleet is not None
    assert len(found.fleet.log_odds) == MAX_CHIPS
    assert analyse_scale(image, detector=model).estimate.details.reference_source == "appearance"


def test_a_network_of_another_contract_is_refused(tmp_path: Path) -> None:
    network = write_fleet_network(tmp_path / "m.onnx", _LENGTHS, outputs=("fleet", "log_length"))
    with pytest.raises(ModelContractError, match=r"chips, fleet, log_length: expected.*log_odds"):
        FleetNetwork(network)
    with pytest.raises(ModelContractError, match="image, logits"):
        FleetNetwork(write_other_model(tmp_path / "classifier.onnx"))
    (tmp_path / "text.onnx").write_text("not a model")
    with pytest.raises(ModelContractError, match=r"text\.onnx"):
        FleetNetwork(tmp_path / "text.onnx")


def _drawn_car(length: float, angle: float, *, gain: float = 1.0) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A car with a bright body, a dark windscreen towards its front and a bright spot on its right wing."""
    side, fine = int(3 * length), 4
    box = np.array([side / 2 + 0.3, side / 2 - 0.2, length, 0.4 * length, angle])
    image = np.full((side * fine, side * fine), 60.0, np.float32)
    rows, columns = (np.mgrid[0 : side * fine, 0 : side * fine] + 0.5) / fine
    dx, dy = columns - box[0], rows - box[1]
    along = (dx * np.cos(angle) + dy * np.sin(angle)) / length
    across = (-dx * np.sin(angle) + dy * np.cos(angle)) / length
    image[(np.abs(along) < 0.5) & (np.abs(across) < 0.2)] = 180
    image[(np.abs(along - 0.15) < 0.08) & (np.abs(across) < 0.17)] = 20
    image[(np.abs(along - 0.4) < 0.08) & (np.abs(across - 0.1) < 0.08)] = 250
    seen = cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA)
    return np.rint(np.clip(gain * seen, 0, 255)).astype(np.uint8), box


@pytest.mark.parametrize("length", [11.0, 16.0, 25.0, 60.0])
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.4])
@pytest.mark.parametrize("gain", [1.0, 0.6])
def test_a_chip_keeps_nothing_of_scale_direction_and_exposure(length: float, angle: float, gain: float) -> None:
    expected = chip(*_drawn_car(40.0, 0.0))
    cut = chip(*_drawn_car(length, angle, gain=gain))
    assert np.sqrt(np.mean((cut - expected) ** 2)) < 0.25  # of a standard deviation of 1
    assert np.corrcoef(cut.ravel(), expected.ravel())[0, 1] > 0.97


def test_vehicles_larger_than_their_image_have_chips() -> None:
    with open_raster(blank_image(40, 16)) as raster:
        chips = vehicle_chips(raster, np.array([[10.0, 4.0, 600.0, 160.0, 1.0]]))
    assert np.isfinite(chips).all()
