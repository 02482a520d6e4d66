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
from research.training.fleet.calibrate import FleetCase, lengths_for, log_errors, mean_error  # noqa: E402 - PyTorch may be missing
from research.training.fleet.data import (  # noqa: E402
    N_FOLDS,
    NORTH_AMERICA,
    Vehicle,
    fold_of,
    load_scene_vehicles,
    load_vehicles,
    random_chip,
    vehicle_at_length,
)
from research.training.fleet.export import export_fleet  # noqa: E402
from research.training.fleet.network import FleetNet  # noqa: E402
from research.training.fleet.train import LESSONS, ChipStream, export, losses, report, trained  # noqa: E402
from vehanchor.detection.appearance import CHIP_SHAPE, FleetLengths  # noqa: E402
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


def test_a_random_chip_still_shows_the_vehicle() -> None:
    rng = np.random.default_rng(0)
    cut = [random_chip(_vehicle("cannes", hood=0.3), rng) for _ in range(60)]
    chips, longer = np.stack([chip for chip, _ in cut]), np.array([factor for _, factor in cut])
    assert chips.shape == (60, *CHIP_SHAPE)
    assert chips.dtype == np.float32
    assert np.isfinite(chips).all()
    body, ground = chips[:, 6:10, 7:17].mean(axis=(1, 2)), chips[:, [0, 15]].mean(axis=(1, 2))
    assert np.mean(body > ground) > 0.9
    assert chips.std(axis=0).mean() > 0.1  # no two alike
    assert 0.85 < longer.min() < 0.92 < 1.08 < longer.max() < 1.15


def test_one_lesson_is_how_long_the_box_is_the_other_how_long_the_vehicle_is() -> None:
    vehicle = _vehicle("cannes", hood=0.3, length_m=4.5)
    stream = ChipStream([vehicle], BOX, seed=1)
    drawn = [stream[k] for k in range(300)]
    metres = np.exp([float(logs[0]) for _, _, logs, _ in drawn])
    assert metres.min() < 0.92 * 4.5 < 1.08 * 4.5 < metres.max()
    lit = [np.mean(chips.numpy()[0, 0, 6:10].mean(axis=0) > 0) for chips, _, _, _ in drawn]  # the vehicle's columns
    assert np.corrcoef(lit, metres)[0, 1] < -0.15  # a box that is longer shows more of the ground
    assert all(float(fleet) == pytest.approx(float(logs[0])) for _, _, logs, fleet in drawn)
    np.testing.assert_allclose(ChipStream([vehicle], FLEET, seed=1)[0][2].numpy(), np.log(4.5), rtol=1e-6)


def test_a_fleet_is_all_vehicles_of_its_image() -> None:
    vehicles = [_vehicle("cannes", hood=0.3, length_m=length) for length in (3.5, 4.5, 5.5)]
    chips, american, logs, fleet = ChipStream(vehicles, FLEET, seed=1)[0]
    assert chips.shape == (8, 1, *CHIP_SHAPE)
    assert american.shape == logs.shape == (8,)
    assert float(fleet) == pytest.approx(np.log([3.5, 4.5, 5.5]).mean(), abs=1e-6)


def test_resolution_alone_changes_a_chip_little() -> None:
    coarse, fine = (vehicle_at_length(_vehicle("cannes", hood=0.3), length) for length in (12.0, 40.0))
    assert np.corrcoef(coarse.ravel(), fine.ravel())[0, 1] > 0.97


def test_half_of_the_stream_is_north_american_whatever_the_sets_sizes() -> None:
    vehicles = [_vehicle(NORTH_AMERICA, hood=0.3)] + [_vehicle("cannes", hood=0.2)] * 9
    stream = ChipStream(vehicles, BOX, 0)
    american = [bool(stream[k][1]) for k in range(400)]
    assert 0.4 < np.mean(american) < 0.6


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


def test_vehicles_of_unknown_length_teach_no_length() -> None:
    network = FleetNet()
    chips, american = torch.zeros(2, 1, 1, *CHIP_SHAPE), torch.tensor([[0.0], [1.0]])
    unknown = torch.full((2, 1), torch.nan)
    parts = losses(FLEET, network, (chips, american, unknown, unknown[:, 0]), CPU)
    assert parts["length"].item() == parts["fleet"].item() == 0
    assert parts["entropy"].item() > 0


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


def test_the_error_counts_sets_alike() -> None:
    lengths = FleetLengths((-1.0, 1.0), (4.0, 5.0), 0.0, 1.0)
    neutral = np.zeros(5)
    cases = [FleetCase("a", neutral, 4.5)] * 9 + [FleetCase("b", neutral, 4.5 / 1.2)]
    errors = log_errors(cases, lengths)
    np.testing.assert_allclose(errors, [0.0] * 9 + [np.log(1.2)], atol=1e-12)
    assert mean_error(cases, errors) == pytest.approx(0.1)


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
