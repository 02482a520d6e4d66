from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from vehanchor.errors import ModelNotFoundError
from vehanchor.models import zoo
from vehanchor.models.zoo import (
    DEFAULT_DETECTOR,
    bundled_models,
    bundled_segmenter,
    fleet_beside,
    resolve_model,
    resolve_segmenter,
    verifier_beside,
)

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def bundled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installation's folder of models with one of each kind, and a second detector."""
    folder = tmp_path / "bundled"
    folder.mkdir()
    for name in ("vehicles", "boats", "fleet", "segmenter-encoder", "segmenter-decoder"):
        (folder / f"{name}.onnx").touch()
    (folder / "vehicles.md").touch()
    monkeypatch.setattr(zoo, "_BUNDLED", folder)
    return folder


def test_neither_a_segmenter_nor_a_fleet_network_is_a_detector(bundled: Path) -> None:
    assert bundled_models() == {"boats": bundled / "boats.onnx", "vehicles": bundled / "vehicles.onnx"}


def test_this_installation_ships_a_detector_of_the_default_name() -> None:
    assert resolve_model() == resolve_model(DEFAULT_DETECTOR) == bundled_models()[DEFAULT_DETECTOR]
    assert resolve_model().is_file()


def test_a_detector_is_given_by_its_name_or_its_path(bundled: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.onnx"
    own.touch()
    assert resolve_model("boats") == bundled / "boats.onnx"
    assert resolve_model(own) == resolve_model(str(own)) == own
    for name in ("fleet", "segmenter-encoder", str(tmp_path / "absent.onnx"), str(tmp_path)):
        with pytest.raises(ModelNotFoundError, match=r"bundled detectors \(boats, vehicles\)"):
            resolve_model(name)


def test_a_bundled_detector_in_eight_bits_is_asked_for_by_precision(
    bundled: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, small = bundled / "vehicles.onnx", bundled / "vehicles-int8.onnx"
    with pytest.raises(ModelNotFoundError, match="no int8 version of 'vehicles'"):
        resolve_model(None, "int8")
    small.touch()
    for quick in (True, False):
        monkeypatch.setattr(zoo, "has_byte_dot_products", lambda quick=quick: quick)
        assert resolve_model(None, "auto") == resolve_model("vehicles", "auto") == (small if quick else plain)
        assert resolve_model(None, "int8") == resolve_model("vehicles-int8") == small
        assert resolve_model("vehicles-int8", "int8") == resolve_model("vehicles-int8", "auto") == small
        assert resolve_model(None, "float32") == resolve_model() == plain
        assert resolve_model("boats", "auto") == bundled / "boats.onnx"
    own = tmp_path / "own.onnx"
    own.touch()
    assert resolve_model(own, "auto") == own
    with pytest.raises(ModelNotFoundError, match="no int8 version"):
        resolve_model(own, "int8")
    assert fleet_beside(small) == fleet_beside(plain) == bundled / "fleet.onnx"
    (bundled / "verifier-int8.onnx").touch()
    assert verifier_beside(small) == bundled / "verifier-int8.onnx"
    assert verifier_beside(plain) is None
    assert list(bundled_models()) == ["boats", "vehicles", "vehicles-int8"]


def test_the_fleet_network_lies_beside_its_detector(bundled: Path, tmp_path: Path) -> None:
    assert fleet_beside(bundled / "vehicles.onnx") == bundled / "fleet.onnx"
    assert fleet_beside(bundled / "boats.onnx") is None
    own = tmp_path / "own.onnx"
    assert fleet_beside(own) is None
    (tmp_path / "own.fleet.onnx").touch()
    assert fleet_beside(own) == tmp_path / "own.fleet.onnx"
    (bundled / "fleet.onnx").unlink()
    assert fleet_beside(bundled / "vehicles.onnx") is None


def test_a_segmenter_is_bundled_whole_or_not_at_all(bundled: Path) -> None:
    pair = bundled / "segmenter-encoder.onnx", bundled / "segmenter-decoder.onnx"
    assert bundled_segmenter() == resolve_segmenter() == pair
    pair[0].unlink()
    assert bundled_segmenter() is None
    with pytest.raises(ModelNotFoundError, match="no bundled segmenter"):
        resolve_segmenter()


def test_a_segmenter_is_given_by_both_its_paths(bundled: Path, tmp_path: Path) -> None:
    del bundled
    encoder, decoder = tmp_path / "encoder.onnx", tmp_path / "decoder.onnx"
    encoder.touch()
    with pytest.raises(ModelNotFoundError, match=r"decoder\.onnx"):
        resolve_segmenter((encoder, decoder))
    decoder.touch()
    assert resolve_segmenter((str(encoder), decoder)) == (encoder, decoder)
