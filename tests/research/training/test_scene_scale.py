"""The training code of the scene-scale network, where PyTorch is installed (extra ``train``), and its density."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from research.training.scene_scale.bins import BINS, FIRST_LOG_GSD, LOG_GSD, LOG_STEP, soft_target
from research.training.scene_scale.density import (
    MOST_TILES,
    TILE_PX,
    Level,
    SceneBins,
    SceneCalibration,
    cut_tiles,
    interval,
    quantiles,
    scene_density,
    tile_places,
)
from tests.conftest import ROOT
from vehanchor.scale.fusion import GRID

torch = pytest.importorskip("torch")
onnxruntime = pytest.importorskip("onnxruntime")

from research.training.scene_scale.calibrate import fit, log_score, report  # noqa: E402 - PyTorch may be missing
from research.training.scene_scale.cases import Case, load, save, searched_cases  # noqa: E402
from research.training.scene_scale.data import (  # noqa: E402
    CropStream,
    ScaledImage,
    chia_photographs,
    coarsest_m_per_px,
    draw_crop,
    featureless,
    load_val_images,
    sources,
)
from research.training.scene_scale.export import export  # noqa: E402
from research.training.scene_scale.network import SceneScaleNet, begin_with_exported  # noqa: E402

_THEIR_BINS = SceneBins(FIRST_LOG_GSD, LOG_STEP)
_SHARP = SceneCalibration(floor=0.01)


def _image(set_name: str, gsd_m_per_px: float, height: int = 400, width: int = 500) -> ScaledImage:
    """A chequerboard whose squares are 4 m wide."""
    rows, columns = (np.arange(n) * gsd_m_per_px // 4 for n in (height, width))
    pixels = ((rows[:, None] + columns) % 2 * 200 + 20).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(pixels[:, :, None], 3, axis=2))
    return ScaledImage(set_name, f"{set_name}.jpg", picture, gsd_m_per_px, 0.0, 0.75 * gsd_m_per_px)


def _seen(gsd_m_per_px: float, tiles: int = 3) -> NDArray[np.float32]:
    """Log-probabilities of tiles that all say the same."""
    return np.repeat(np.log(soft_target(gsd_m_per_px, lost=0.01))[None], tiles, axis=0)


def test_a_target_peaks_at_its_scale_and_is_flat_where_nothing_can_be_told() -> None:
    target = soft_target(0.2)
    assert target.sum() == pytest.approx(1.0, abs=1e-6)
    assert abs(LOG_GSD[target.argmax()] - np.log(0.2)) <= LOG_STEP / 2
    assert soft_target(0.2, label_spread=0.15).max() < target.max()
    np.testing.assert_allclose(soft_target(0.2, lost=1.0), 1 / BINS)


@pytest.mark.parametrize(("width", "height"), [(160, 160), (256, 256), (1000, 700), (4096, 4096), (9000, 200)])
def test_tiles_lie_inside_the_image_and_are_not_too_many(width: int, height: int) -> None:
    levels = tile_places(width, height)
    assert [level.factor for level in levels] == [f for f in (1, 2, 4, 8) if min(width, height) >= TILE_PX * f]
    for level in levels:
        assert 1 <= len(level.places) <= MOST_TILES
        assert (level.places >= 0).all()
        assert (level.places + TILE_PX * level.factor <= (width, height)).all()


def test_the_tiles_of_a_level_reach_all_sides_of_the_image() -> None:
    for level in tile_places(3000, 2000):
        np.testing.assert_array_equal(level.places.min(axis=0), (0, 0))
        np.testing.assert_array_equal(level.places.max(axis=0) + TILE_PX * level.factor, (3000, 2000))


def test_a_reduced_tile_shows_the_mean_of_what_it_covers() -> None:
    image = np.zeros((320, 320, 3), np.uint8)
    image[::2] = 100
    tiles = cut_tiles(image, Level(2, np.array([[0, 0]])))
    assert tiles.shape == (1, 3, TILE_PX, TILE_PX)
    np.testing.assert_array_equal(tiles, 50)


def test_a_small_image_is_mirrored_to_fill_its_tile() -> None:
    image = np.arange(40, dtype=np.uint8)[None, :, None].repeat(30, 0).repeat(3, 2)
    (level,) = tile_places(40, 30)
    row = cut_tiles(image, level)[0, 0, 0]
    np.testing.assert_array_equal(row[:80], [*range(40), *range(39, -1, -1)])


def test_levels_that_say_the_same_of_one_image_agree_in_its_density() -> None:
    density = scene_density([_seen(0.1), _seen(0.2), _seen(0.4)], [1, 2, 4], _THEIR_BINS, _SHARP)
    assert density.sum() == pytest.approx(1.0)
    assert quantiles(density, [0.5])[0] == pytest.approx(0.1, rel=0.03)
    low, high = interval(density)
    assert 0.06 < low < 0.1 < high < 0.16


def test_tiles_that_disagree_widen_the_density() -> None:
    agreed = scene_density([_seen(0.1, 2)], [1], _THEIR_BINS, _SHARP)
    torn = scene_density([np.concatenate([_seen(0.07, 1), _seen(0.14, 1)])], [1], _THEIR_BINS, _SHARP)
    widths = [np.log(high / low) for low, high in (interval(agreed), interval(torn))]
    assert widths[1] > widths[0] * 1.2


def test_a_scene_that_shows_nothing_leaves_the_scale_open() -> None:
    density = scene_density([np.full((5, BINS), -np.log(BINS), np.float32)], [1], _THEIR_BINS, _SHARP)
    np.testing.assert_allclose(density, 1 / len(GRID))


def test_what_is_finer_than_all_training_is_not_denied() -> None:
    finest = float(np.exp(FIRST_LOG_GSD))
    density = scene_density([_seen(finest)], [1], _THEIR_BINS, _SHARP)
    assert interval(density)[0] < 0.005
    known = scene_density([_seen(finest), _seen(8 * 0.01)], [1, 8], _THEIR_BINS, _SHARP)
    assert quantiles(known, [0.5])[0] == pytest.approx(0.01, rel=0.1)


def test_the_floor_bounds_what_one_witness_can_deny() -> None:
    density = scene_density([_seen(0.1)], [1], _THEIR_BINS, SceneCalibration(temperature=4.0, floor=0.02))
    assert density.min() >= 0.02 / len(GRID) * 0.999


@pytest.mark.parametrize("gsd", [0.08, 0.1, 0.19])
def test_a_crop_has_the_wanted_scale_at_every_angle(gsd: float) -> None:
    image = _image("cannes", 0.1)
    for seed in range(8):
        crop = draw_crop(np.random.default_rng(seed), image, gsd)
        assert crop.shape == (TILE_PX, TILE_PX, 3)
        edges = cv2.Canny(crop, 100, 200) > 0  # 2 * side^2 / square of edges, in a chequerboard
        lines = 2 * TILE_PX**2 * gsd / 4
        assert edges.sum() == pytest.approx(lines, rel=0.45)


def test_no_set_owns_a_scale_that_another_can_show() -> None:
    stream = CropStream([_image("cannes", 0.2), _image("estonia", 0.1), _image("ucm", 0.3)], 0)
    rng = np.random.default_rng(0)
    drawn = [stream._draw(rng) for _ in range(900)]
    for low, high in ((0.15, 0.2), (0.225, 0.25), (0.3, 0.5)):
        names = {image.set for image, gsd in drawn if low < gsd < high}
        able = {image.set for image in stream.images if image.finest_m_per_px < low and coarsest_m_per_px(image) > high}
        assert names >= able
    assert all(image.finest_m_per_px <= gsd <= coarsest_m_per_px(image) for image, gsd in drawn)


def test_the_stream_gives_the_same_example_for_the_same_number() -> None:
    stream = CropStream([_image("cannes", 0.2)], 3)
    for index in range(4):
        (pixels, target), (again, same) = stream[index], stream[index]
        assert pixels.shape == (3, TILE_PX, TILE_PX)
        assert pixels.dtype == torch.uint8
        assert torch.equal(pixels, again)
        assert torch.equal(target, same)
    assert not torch.equal(stream[0][0], stream[1][0])


def test_featureless_crops_differ() -> None:
    rng = np.random.default_rng(0)
    crops = [featureless(rng) for _ in range(6)]
    assert np.std([crop.mean() for crop in crops]) > 10
    assert all(crop.shape == (TILE_PX, TILE_PX, 3) for crop in crops)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_file_says_what_the_network_says_and_names_its_bins(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SceneScaleNet().eval()
    export(network, tmp_path / "scene.onnx", {"temperature": 0.5})
    assert (tmp_path / "scene.onnx").stat().st_size <= 4_000_000
    session = onnxruntime.InferenceSession(tmp_path / "scene.onnx", providers=["CPUExecutionProvider"])
    tiles = np.random.default_rng(0).integers(0, 256, (3, 3, TILE_PX, TILE_PX), np.uint8)
    log_probs = session.run(["log_probs"], {"tiles": tiles})[0]
    assert log_probs.shape == (3, BINS)
    np.testing.assert_allclose(np.exp(log_probs).sum(axis=1), 1.0, rtol=1e-5)
    with torch.no_grad():
        np.testing.assert_allclose(log_probs, network(torch.from_numpy(tiles).float() / 255), atol=1e-3)
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["vehanchor.scene_bins"]) == [FIRST_LOG_GSD, LOG_STEP]
    assert json.loads(metadata["vehanchor.scene_calibration"]) == {"temperature": 0.5}

    cases = searched_cases(session, [_image("cannes", 0.2)], reduced=1)
    save(cases, tmp_path / "cases.npz")
    again = load(tmp_path / "cases.npz")
    assert [c[:5] for c in again] == [c[:5] for c in cases]
    assert [c.reduced for c in again] == [False, True]
    for before, after in zip(cases, again, strict=True):
        for a, b in zip(before.log_probs, after.log_probs, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_network_that_is_too_sure_of_itself_is_cooled() -> None:
    rng = np.random.default_rng(0)
    cases = [
        Case("cannes", str(k), 0.2, False, (1,), (_seen(float(0.2 * np.exp(rng.normal(0, 0.5)))),)) for k in range(20)
    ]
    calibration = fit(cases)
    assert calibration.temperature < 0.5
    assert log_score(cases, calibration) > log_score(cases, SceneCalibration()) + 0.5
    told = [line.split() for line in report(cases, calibration)[1:]]
    assert [line[0] for line in told] == ["cannes", "all"]
    assert {line[4] for line in told} == {"20"}


@pytest.mark.data
def test_what_trains_is_of_no_val_split_and_not_for_evaluation_only(real_data: Path) -> None:
    found = sources(real_data)
    names = [source.path.name for source in found]
    assert len(found) > 1700
    assert len({source.path for source in found}) == len(found)
    for word in ("harlem", "drashti", "crossings", "minsk_", "ucas", "dota", "DJI_0010"):
        assert not [name for name in names if word in name]
    assert not {image.name for image in load_val_images(real_data, without={"building"})} & set(names)


def test_training_goes_on_from_the_bundled_files_answers() -> None:
    torch.manual_seed(0)
    bundled = ROOT / "skill" / "vehanchor" / "models" / "bundled" / "scene-scale.onnx"
    tiles = torch.randint(0, 255, (6, 3, 160, 160), dtype=torch.uint8)
    network = SceneScaleNet()
    begin_with_exported(network, bundled, tiles.float() / 255)
    with torch.no_grad():
        found = np.exp(network.eval()(tiles.float() / 255).numpy())
    session = onnxruntime.InferenceSession(bundled, providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(found, np.exp(session.run(["log_probs"], {"tiles": tiles.numpy()})[0]), atol=1e-5)


def test_numbers_of_chia_train_or_check_and_never_both(tmp_path: Path) -> None:
    (tmp_path / "chia").mkdir()
    rows = "".join(f"{{}}DJI_{k:04d}.jpg,0.0{k}\n" for k in (16, 17, 18, 19))
    for table, folder in (("table.csv", ""), ("crops.csv", "crops/")):
        text = "file,gsd_m_per_px\n" + rows.format(*[folder] * 4) + f"{folder}DJI_0021.jpg,\n"
        (tmp_path / "chia" / table).write_text(text)
    train, check = ([source.path.stem for source in chia_photographs(tmp_path, odd=odd)] for odd in (True, False))
    assert train == ["DJI_0017", "DJI_0019"] * 2  # a photograph and its crop; an oblique one has no scale
    assert check == ["DJI_0016", "DJI_0018"] * 2
