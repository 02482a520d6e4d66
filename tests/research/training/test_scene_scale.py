"""Training code of the scene-scale network and its density, where PyTorch is installed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from research.training.scene_scale.bins import BINS, FIRST_LOG_GSD, LOG_STEP
from tests.conftest import ROOT
from vehanchor.detection.scene_scale import TILE_PX

torch = pytest.importorskip("torch")
onnxruntime = pytest.importorskip("onnxruntime")

from research.training.scene_scale.cases import load, save, searched_cases  # noqa: E402
from research.training.scene_scale.data import (  # noqa: E402
    ScaledImage,
    draw_crop,
    load_val_images,
    sources,
)
from research.training.scene_scale.export import export  # noqa: E402
from research.training.scene_scale.network import SceneScaleNet, begin_with_exported  # noqa: E402

pytestmark = pytest.mark.slow


def _image(set_name: str, gsd_m_per_px: float, height: int = 400, width: int = 500) -> ScaledImage:
    """A chequerboard whose squares are 4 m wide."""
    rows, columns = (np.arange(n) * gsd_m_per_px // 4 for n in (height, width))
    pixels = ((rows[:, None] + columns) % 2 * 200 + 20).astype(np.uint8)
    picture = np.ascontiguousarray(np.repeat(pixels[:, :, None], 3, axis=2))
    return ScaledImage(
        set_name,
        f"{set_name}.jpg",
        pixels=picture,
        gsd_m_per_px=gsd_m_per_px,
        label_spread=0.0,
        finest_m_per_px=0.75 * gsd_m_per_px,
    )


@pytest.mark.parametrize("gsd", [0.08, 0.1, 0.19])
def test_a_crop_has_the_wanted_scale_at_every_angle(gsd: float) -> None:
    image = _image("cannes", 0.1)
    for seed in range(8):
        crop = draw_crop(np.random.default_rng(seed), image, gsd)
        assert crop.shape == (TILE_PX, TILE_PX, 3)
        edges = cv2.Canny(crop, 100, 200) > 0  # 2 * side^2 / square of edges, in a chequerboard
        lines = 2 * TILE_PX**2 * gsd / 4
        assert edges.sum() == pytest.approx(lines, rel=0.45)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_file_says_what_the_network_says_and_names_its_bins(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SceneScaleNet().eval()
    export(network, tmp_path / "scene.onnx", {"temperature": 0.5})
    assert (tmp_path / "scene.onnx").stat().st_size <= 4_000_000
    session = onnxruntime.InferenceSession(
        tmp_path / "scene.onnx", providers=["CPUExecutionProvider"]
    )
    tiles = np.random.default_rng(0).integers(0, 256, (3, 3, TILE_PX, TILE_PX), np.uint8)
    log_probs = session.run(["log_probs"], {"tiles": tiles})[0]
    assert log_probs.shape == (3, BINS)
    np.testing.assert_allclose(np.exp(log_probs).sum(axis=1), 1.0, rtol=1e-5)
    with torch.no_grad():
        np.testing.assert_allclose(
            log_probs, network(torch.from_numpy(tiles).float() / 255), atol=1e-3
        )
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


@pytest.mark.data
def test_what_trains_is_of_no_val_split_and_not_for_evaluation_only(
    real_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("research.training.scene_scale.data._load", lambda source: source)
    images = sources(real_data)
    names = [source.path.name for source in images]
    assert len(images) > 1700
    assert len({source.path for source in images}) == len(images)
    for word in ("harlem", "drashti", "crossings", "minsk_", "ucas", "dota", "DJI_0010"):
        assert not [name for name in names if word in name]
    reported: Any = load_val_images(real_data, without={"building"})
    assert not {source.path.name for source in reported} & set(names)


def test_training_goes_on_from_the_bundled_files_answers() -> None:
    torch.manual_seed(0)
    bundled = ROOT / "skill" / "vehanchor" / "models" / "bundled" / "scene-scale.onnx"
    tiles = torch.randint(0, 255, (6, 3, 160, 160), dtype=torch.uint8)
    network = SceneScaleNet()
    begin_with_exported(network, bundled, tiles.float() / 255)
    with torch.no_grad():
        expected = np.exp(network.eval()(tiles.float() / 255).numpy())
    session = onnxruntime.InferenceSession(bundled, providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(
        expected, np.exp(session.run(["log_probs"], {"tiles": tiles.numpy()})[0]), atol=1e-5
    )
