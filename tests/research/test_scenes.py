from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from research.scenes import CATEGORIES, Layout, Scene, render_scene
from research.scenes.__main__ import app
from research.scenes.fleet import Fleet, VehicleModel
from research.scenes.painter import Painter
from research.scenes.sprites import Sun
from research.scenes.world import Material, PlacedVehicle, Surface, World
from vehanchor.errors import InvalidParameterError

LAYOUTS = get_args(Layout)


def _digest(scene: Scene) -> str:
    state = hashlib.sha256(scene.image.tobytes())
    for mask in scene.masks.values():
        state.update(mask.tobytes())
    state.update(repr((scene.vehicles, scene.objects, sorted(scene.parameters.items()))).encode())
    return state.hexdigest()


@pytest.fixture(scope="module")
def parking() -> Scene:
    return render_scene(0.15, width_px=512, height_px=384, seed=3, layout="parking")


def test_the_same_arguments_give_the_same_bytes_whatever_the_threads() -> None:
    threads = cv2.getNumThreads()
    digests = set()
    try:
        for count in (1, 2):
            cv2.setNumThreads(count)
            digests.add(_digest(render_scene(0.2, width_px=300, height_px=200, seed=11)))
    finally:
        cv2.setNumThreads(threads)
    assert len(digests) == 1


def test_a_larger_image_is_painted_in_tiles_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = render_scene(0.15, width_px=400, height_px=200, seed=5, layout="urban")
    monkeypatch.setattr("research.scenes.render._TILE_PX", 128)
    tiled = render_scene(0.15, width_px=400, height_px=200, seed=5, layout="urban")
    difference = np.abs(whole.image.astype(int) - tiled.image)
    assert np.mean(difference > 12) < 0.002
    assert difference.mean() < 0.5
    assert whole.vehicles == tiled.vehicles


@pytest.mark.parametrize(("gsd", "layout"), [(0.01, "parking"), *((1.0, each) for each in LAYOUTS)])
def test_every_layout_renders_at_every_scale(gsd: float, layout: Layout) -> None:
    scene = render_scene(gsd, width_px=96, height_px=64, seed=7, layout=layout)
    assert scene.image.std() > 2
    assert scene.parameters["layout"] == layout


def test_half_the_gsd_shows_the_same_place_in_twice_the_pixels() -> None:
    coarse = render_scene(0.4, width_px=192, height_px=192, seed=9, layout="urban")
    fine = render_scene(0.2, width_px=384, height_px=384, seed=9, layout="urban")
    assert len(coarse.vehicles) == len(fine.vehicles) > 5
    for one, other in zip(coarse.vehicles, fine.vehicles, strict=True):
        assert one.kind == other.kind
        assert (2 * one.x_px, 2 * one.y_px) == pytest.approx((other.x_px, other.y_px), abs=1e-6)
        assert 2 * one.length_px == pytest.approx(other.length_px)
    for category in CATEGORIES:
        areas = [
            sum(o.area_m2 for o in s.objects if o.category == category) for s in (coarse, fine)
        ]
        assert areas[0] == pytest.approx(areas[1], rel=0.03, abs=8)


def test_vehicles_are_inside_and_have_plausible_sizes(parking: Scene) -> None:
    assert len(parking.vehicles) > 20
    for vehicle in parking.vehicles:
        assert 0 <= vehicle.x_px < 512
        assert 0 <= vehicle.y_px < 384
        assert -math.pi <= vehicle.angle_rad <= math.pi
        metres = vehicle.length_px * parking.gsd_m_per_px
        low, high = (3.3, 5.8) if vehicle.kind == "small-vehicle" else (6, 17)
        assert low < metres < high
        assert 0.15 < vehicle.width_px / vehicle.length_px < 0.5
        corners = vehicle.corners()
        if not vehicle.difficult:
            assert corners.min() >= 0
            assert (corners <= (512, 384)).all()


@pytest.mark.parametrize("mean", [4.2, 4.6, 5.0])
def test_the_fleet_has_the_mean_and_mode_the_docstring_says(mean: float) -> None:
    fleet = Fleet(mean, np.random.default_rng(0))
    models = [fleet.small() for _ in range(5_000)]
    lengths = np.array([model.length_m for model in models])
    assert lengths.mean() == pytest.approx(mean, rel=0.005)
    assert lengths.std() / mean == pytest.approx(0.087, abs=0.004)
    assert lengths.max() <= fleet.max_length_m
    grid = np.linspace(0.8, 1.2, 401) * mean
    density = np.exp(-(((grid[:, None] - lengths) / (0.02 * mean)) ** 2) / 2).sum(axis=1)
    assert grid[density.argmax()] / mean == pytest.approx(1.010, abs=0.012)
    widths = np.array([model.width_m for model in models])
    assert (widths / lengths).mean() == pytest.approx(0.40, abs=0.01)


BODIES = ("city", "sedan", "van", "pickup", "truck", "caravan")


@pytest.mark.parametrize(
    ("gsd", "body"), [(0.05, "sedan"), (0.6, "van"), *((0.17, body) for body in BODIES)]
)
def test_a_drawn_vehicle_is_exactly_as_long_as_its_record(
    gsd: float, body: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    length, width = (4.37, 1.81) if body not in ("truck", "caravan") else (7.1, 2.4)
    monkeypatch.setattr(Painter, "_low_shadows", lambda *_: None)
    for turn in (0.0, -math.pi / 2):
        cover = _coverage(body, length, width=width, gsd=gsd, turn=turn)
        if turn:
            cover = cover.T
        assert cover.sum() * gsd**2 == pytest.approx(length * width, rel=0.12)
        for profile, extent in ((cover.max(axis=0), length), (cover.max(axis=1), width)):
            first, last = _edges(profile)
            assert (last - first) * gsd == pytest.approx(extent, abs=0.25 * gsd + 0.02)
            assert (first + last) / 2 * gsd == pytest.approx(4.0, abs=0.25 * gsd + 0.02)


def _coverage(
    body: str, length: float, width: float, gsd: float, turn: float
) -> NDArray[np.float64]:
    """Measure the cover of pixels by a vehicle at (4, 4) m, drawn on bright and black ground."""
    over = 2
    pixels = math.ceil(8 / gsd)
    placed = PlacedVehicle(
        VehicleModel("small-vehicle", body, length_m=length, width_m=width, paint=(90, 90, 90)),
        4.0,
        y=4.0,
        angle=turn,
    )
    floor = np.array([[-50.0, -50], [50, -50], [50, 50], [-50, 50]])
    looks = []
    for level, vehicles in ((0, [placed]), (200, [placed]), (200, [])):
        world = World(surfaces=[Surface(floor, (level,) * 3, Material.PLAIN)], vehicles=vehicles)
        side = pixels * over
        tile = Painter(
            world, Sun(0.3, 1.0), rng=np.random.default_rng(0), px_per_m=over / gsd
        ).paint(0, 0, side, side)
        looks.append(
            cv2.resize(tile.rgb, (pixels, pixels), interpolation=cv2.INTER_AREA)[:, :, 1].astype(
                float
            )
        )
    black, bright, empty = looks
    return np.asarray(1 - (bright - black) / empty, dtype=np.float64)


def _edges(profile: NDArray[np.float64]) -> tuple[float, float]:
    """Find the ends of a covered stretch; the outermost pixels count by their cover."""
    covered = np.flatnonzero(profile > 0.97)
    first = int(covered[0])
    last = int(covered[-1]) + 1
    return first - float(profile[:first].sum()), last + float(profile[last:].sum())


def test_masks_agree_with_the_objects() -> None:
    scene = render_scene(0.25, width_px=512, height_px=512, seed=4, layout="urban")
    cover = dict.fromkeys(CATEGORIES, 0)
    for item in scene.objects:
        cover[item.category] += 1
        assert item.instance == cover[item.category]
        pixels = int((scene.masks[item.category] == item.instance).sum())
        assert item.area_m2 == pytest.approx(pixels * 0.25**2)
        assert item.area_m2 <= item.full_area_m2 * 1.1 + 2
    for category, mask in scene.masks.items():
        assert mask.max() == cover[category]
    assert cover["building"] > 10


@pytest.fixture(params=[".png", ".jpg"])
def written(parking: Scene, tmp_path: Path, request: pytest.FixtureRequest) -> list[Path]:
    """Write a scene as PNG and as JPEG."""
    return parking.write(tmp_path / f"view{request.param}")


@pytest.fixture
def facts(written: list[Path], tmp_path: Path) -> dict[str, Any]:
    assert written
    content: dict[str, Any] = json.loads((tmp_path / "view.json").read_text())
    return content


def test_a_scene_writes_its_files(written: list[Path]) -> None:
    image = written[0].name
    masks = [f"view_{category}.png" for category in CATEGORIES]
    assert image in ("view.png", "view.jpg")
    assert sorted(file.name for file in written) == sorted([image, "view.json", "view.txt", *masks])
    assert all(file.is_file() for file in written)


def test_a_written_image_reads_back(parking: Scene, written: list[Path]) -> None:
    image = cv2.imread(str(written[0]), cv2.IMREAD_COLOR)
    assert image is not None
    if written[0].suffix == ".png":
        np.testing.assert_array_equal(image[:, :, ::-1], parking.image)


def test_a_written_scene_states_its_parameters(facts: dict[str, Any]) -> None:
    assert facts["gsd_m_per_px"] == 0.15
    assert (facts["width_px"], facts["height_px"], facts["seed"]) == (512, 384, 3)
    assert facts["parameters"]["layout"] == "parking"


def test_written_masks_read_back(parking: Scene, facts: dict[str, Any], tmp_path: Path) -> None:
    for category in CATEGORIES:
        mask = cv2.imread(str(tmp_path / f"view_{category}.png"), cv2.IMREAD_UNCHANGED)
        assert mask is not None
        np.testing.assert_array_equal(mask, parking.masks[category])
        objects = [item for item in facts["objects"] if item["category"] == category]
        for item in objects:
            n_pixels = int((mask == item["instance"]).sum())
            assert item["area_m2"] == pytest.approx(n_pixels * 0.15**2)


@pytest.mark.usefixtures("written")
def test_written_labels_read_back(parking: Scene, tmp_path: Path) -> None:
    header, *lines = (tmp_path / "view.txt").read_text().splitlines()
    assert header == "gsd:0.15"
    assert len(lines) == len(parking.vehicles)
    for line, vehicle in zip(lines, parking.vehicles, strict=True):
        *numbers, kind, difficult = line.split(" ")
        np.testing.assert_allclose(
            np.array(numbers, dtype=float).reshape(4, 2), vehicle.corners(), atol=6e-4
        )
        assert (kind, difficult) == (vehicle.kind, str(int(vehicle.difficult)))


@pytest.mark.parametrize(
    "parameters",
    [
        {"gsd_m_per_px": 0.0},
        {"width_px": 0},
        {"n_vehicles": -1},
        {"mean_vehicle_length_m": 0.0},
        {"layout": "moon"},
    ],
)
def test_bad_parameters_are_refused_by_name(parameters: dict[str, Any]) -> None:
    (name,) = parameters
    with pytest.raises(InvalidParameterError, match=name):
        render_scene(**{"gsd_m_per_px": 0.15, "width_px": 32, "height_px": 32, **parameters})


def _models(count: int = 2_000, mean: float = 4.6) -> list[tuple[str, float]]:
    fleet = Fleet(mean, np.random.default_rng(0), "mixed")
    return [(model.body, model.length_m) for model in (fleet.small() for _ in range(count))]


@pytest.mark.parametrize("mean", [4.0, 5.0])
def test_a_mixed_fleet_has_the_mean_length_asked_for(mean: float) -> None:
    assert np.mean([length for _, length in _models(mean=mean)]) == pytest.approx(mean, rel=0.01)


def test_the_same_seed_draws_the_same_mixed_scene_and_names_bodies() -> None:
    first, again = (
        render_scene(
            0.15, width_px=320, height_px=320, seed=3, layout="parking", fleet_kind="mixed"
        )
        for _ in range(2)
    )
    np.testing.assert_array_equal(first.image, again.image)
    assert {vehicle.body for vehicle in first.vehicles} & {"kei", "crew cab", "single cab"}
    assert first.parameters["fleet_kind"] == "mixed"


@pytest.fixture
def run(tmp_path: Path, plain_terminal: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``python -m research.scenes`` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_scene_writes_an_image_and_its_truth(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "scene.png"
    result = run(
        out,
        "--gsd",
        "0.2",
        "--size",
        "300",
        "200",
        "--seed",
        "3",
        "--layout",
        "parking",
        "--fleet",
        "5",
    )
    assert result.exit_code == 0, result.stderr
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.shape == (200, 300, 3)
    printed = "".join(result.stdout.split())
    for path in tmp_path.iterdir():
        assert path.name in printed
    truth = json.loads((tmp_path / "scene.json").read_text())
    assert truth["gsd_m_per_px"] == 0.2
    assert truth["parameters"]["layout"] == "parking"
