"""The training code of the network that tells fleets apart, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnxruntime = pytest.importorskip("onnxruntime")

from research.scenes import render_scene  # noqa: E402
from research.training.fleet.calibrate import FleetCase, lengths_for, log_errors  # noqa: E402 - PyTorch may be missing
from research.training.fleet.data import (  # noqa: E402
    N_FOLDS,
    NORTH_AMERICA,
    Vehicle,
    fold_of,
    load_scene_vehicles,
    load_vehicles,
    vehicle_at_length,
)
from research.training.fleet.export import export_fleet  # noqa: E402
from research.training.fleet.network import FleetNet  # noqa: E402
from research.training.fleet.train import LESSONS, ChipStream, export, losses, report, trained  # noqa: E402
from vehanchor.detection.appearance import FleetLengths  # noqa: E402
from vehanchor.detection.fleet import FleetNetwork  # noqa: E402

pytestmark = pytest.mark.slow

BOX, FLEET = LESSONS
CPU = torch.device("cpu")


def _vehicle(set_name: str, *, hood: float, file: str = "a.png", length_m: float | None = None) -> Vehicle:
    """A bright car whose dark windscreen begins ``hood`` of its length behind the front."""
    image = np.full((110, 110, 3), 70, np.uint8)
    cv2.rectangle(image, (35, 47), (74, 62), (200, 200, 200), -1)
    screen = round(75 - 40 * hood)
    cv2.rectangle(image, (screen - 6, 48), (screen, 61), (30, 30, 30), -1)
    return Vehicle(set_name, file, image, np.array([55.0, 55, 40, 16, 0.0]), length_m)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_a_network_learns_a_longer_hood_and_its_file_says_the_same(tmp_path: Path) -> None:
    vehicles = [_vehicle(NORTH_AMERICA, hood=0.34, length_m=5.1), _vehicle("cannes", hood=0.12, length_m=4.1)]
    networks = [trained(vehicles, lesson, seed=0, steps=30) for lesson in LESSONS]
    export(networks, tmp_path / "fleet.onnx")
    chips = np.stack([vehicle_at_length(v, 16.0) for v in vehicles])[:, None]
    session = onnxruntime.InferenceSession(tmp_path / "fleet.onnx")
    odds, lengths = session.run(None, {"chips": chips})
    assert odds.shape == lengths.shape == (2,)
    assert odds[0] > odds[1] + 1
    assert lengths[0] > lengths[1] + 0.05
    mirrored = session.run(None, {"chips": np.ascontiguousarray(chips[..., ::-1, ::-1])})
    np.testing.assert_allclose(mirrored, [odds, lengths], atol=1e-4)
    lines = report(networks, [v._replace(file=f"{k}.png") for v in vehicles for k in (0, 0, 0, 1, 1, 1)])
    assert len(lines) == 1 + 2 * 4  # two sets at four lengths
    assert "   2 " in lines[1]  # images


def test_rendered_cars_teach_their_length_and_no_region(tmp_path: Path) -> None:
    scene = render_scene(0.15, width_px=300, height_px=200, seed=3, layout="parking")
    scene.write(tmp_path / "scene.jpg")
    vehicles = load_scene_vehicles(tmp_path)
    lengths = sorted(vehicle.length_m for vehicle in vehicles if vehicle.length_m is not None)
    assert len(lengths) == len(vehicles) > 5
    assert 3 < lengths[0] < lengths[-1] < 6.5
    chips, american, logs, fleet = ChipStream(vehicles, FLEET, 0)[0]
    assert american.isnan().all()
    assert all(any(math.exp(log) == pytest.approx(each, rel=1e-4) for each in lengths) for log in logs)
    parts = losses(FLEET, FleetNet(), (chips[None], american[None], logs[None], fleet[None]), CPU)
    assert parts["entropy"].item() == 0
    assert parts["length"].item() > 0
    assert parts["fleet"].item() > 0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_networks_file_says_what_its_answers_mean_and_for_which_detector(tmp_path: Path) -> None:
    vehicles = [_vehicle(NORTH_AMERICA, hood=0.3), _vehicle("cannes", hood=0.2)]
    export([trained(vehicles, lesson, 0, steps=2) for lesson in LESSONS], tmp_path / "fleet.onnx")
    lengths = FleetLengths((1.4, 1.6), (4.3, 5.1), 0.3, 1.0)
    (tmp_path / "fleet_lengths.json").write_text(json.dumps(lengths._asdict()))
    export_fleet(tmp_path, tmp_path / "mine.fleet.onnx", "mine")
    card = FleetNetwork(tmp_path / "mine.fleet.onnx").card
    assert (card.detector, card.lengths) == ("mine", lengths)


def test_neighbours_are_in_one_fold_and_no_fold_is_empty() -> None:
    assert len({fold_of(f"cannes_{number:05d}.png", "cannes") for number in (0, 1, 49, 50)}) == 1
    folds = [fold_of(f"ucm_{number}.png", "ucm") for number in range(400)]
    assert np.bincount(folds, minlength=N_FOLDS).min() > 60


@pytest.mark.data
def test_vehicles_are_those_of_the_train_split(real_data: Path) -> None:
    vehicles = load_vehicles(real_data)
    assert {v.set for v in vehicles} == {"cannes", "saopaulo", "jekhor", "ucm", "estonia"}
    assert len(vehicles) > 5000
    for vehicle in vehicles[:: len(vehicles) // 50]:
        height, width = vehicle.pixels.shape[:2]
        assert 0 <= vehicle.box[0] <= width
        assert 0 <= vehicle.box[1] <= height
        assert vehicle.box[2] <= 41


def test_the_middle_of_the_lengths_leaves_the_sets_without_a_bias() -> None:
    cases = [FleetCase("a", np.full(5, np.log(4.2)), 4.0)] * 9 + [FleetCase("b", np.full(5, np.log(4.8)), 5.0)]
    errors = log_errors(cases, lengths_for(1.0, 1e-9, cases))
    assert np.median(errors[:9]) == pytest.approx(-np.median(errors[9:]), abs=0.04)  # twice 0.02, of the straight line
