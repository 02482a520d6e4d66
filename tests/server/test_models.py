from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.models import write_chip_network, write_other_model
from tests.sam_models import SamFiles
from vehanchor.detection.detector import load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import BUNDLED_MODELS, BundledModel, bundled_file
from vehanchor_server import models as server_models
from vehanchor_server.errors import CallError
from vehanchor_server.models import SLOW_IMPORTS, Models
from vehanchor_server.settings import Settings
from vehanchor_server.tools.scale_arguments import scale_options


def calibration_file(path: Path, **fields: Any) -> Path:
    """A calibration as ``vehanchor calibrate`` writes it."""
    record = {
        "kind": "vehanchor.calibration.v1",
        "reference_length_m": 4.31,
        "reference_length_ci95_low_m": 4.2,
        "reference_length_ci95_high_m": 4.4,
        "reference_length_sd_m": 0.1,
        "source": "labels",
        "n_vehicles": 500,
        "n_images": 9,
        "mode_length_px": 30.0,
        "median_gsd_m_per_px": 0.15,
        "detector": None,
        "detector_sha256": None,
        **fields,
    }
    path.write_text(json.dumps(record))
    return path


def test_models_are_loaded_once(settings: Settings) -> None:
    models = Models(settings)
    assert not models.ready
    models.load_all()
    assert models.ready
    assert models.detector() is models.detector()
    assert models.segmenter() is models.segmenter()
    assert models.failure is None


def test_a_model_that_appears_later_is_found(tmp_path: Path, detector_path: Path) -> None:
    path = tmp_path / "late.onnx"
    models = Models(Settings(detector=str(path), threads=1))
    with pytest.raises(CallError, match="model_unavailable"):
        models.detector()
    assert models.failure == "model_not_found"
    path.write_bytes(detector_path.read_bytes())
    assert models.detector().path == path
    assert models.failure is None


def test_the_calibration_is_for_callers_who_know_no_fleet(
    settings: Settings, tmp_path: Path
) -> None:
    settings = replace(settings, calibration=calibration_file(tmp_path / "c.json"))
    models = Models(settings)

    def reference(**given: Any) -> float | None:
        calibration = scale_options(given, settings, models).reference.calibration
        return None if calibration is None else calibration.reference_length_m

    assert reference() == 4.31
    assert reference(region="europe") is None
    assert reference(reference_length_m=4.8) is None
    assert Models(replace(settings, calibration=None)).calibration() is None


def test_a_calibration_must_be_the_detectors(
    settings: Settings, detector_path: Path, tmp_path: Path
) -> None:
    card = load_detector(detector_path, Runtime(threads=1)).card
    fitting = calibration_file(
        tmp_path / "fitting.json", detector=card.name, detector_sha256=card.sha256
    )
    assert Models(replace(settings, calibration=fitting)).calibration() is not None
    foreign = calibration_file(
        tmp_path / "foreign.json", detector="other", detector_sha256="0" * 64
    )
    for file, code in (
        (foreign, "calibration_mismatch"),
        (tmp_path / "none.json", "calibration_unreadable"),
    ):
        models = Models(replace(settings, calibration=file))
        with pytest.raises(CallError, match=rf"model_unavailable: .*\({code}\).*--calibration"):
            models.calibration()
        models.detector()
        models.segmenter()
        assert not models.ready
        assert models.failure == code


def test_a_segmenter_that_cannot_be_loaded_is_not_ready(
    settings: Settings, segmenter_paths: SamFiles
) -> None:
    models = Models(replace(settings, segmenter=(segmenter_paths[1], segmenter_paths[0])))
    models.load_all()
    assert models.failure == "model_contract"
    assert not models.ready


def test_an_added_bundled_model_may_be_read_by_workers(
    settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_other_model(tmp_path / "added.onnx")
    added = BundledModel(name="added", file=str(path), role="ruler")
    monkeypatch.setattr(server_models, "BUNDLED_MODELS", (*BUNDLED_MODELS, added))
    assert path in Models(settings).files()


def test_all_bundled_models_of_an_estimate_may_be_read_by_workers() -> None:
    files = Models(Settings()).files()
    assert {model.path for model in BUNDLED_MODELS} <= set(files)


def test_the_chip_network_of_an_own_detector_may_be_read_by_workers(
    detector_path: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.onnx"
    own.write_bytes(detector_path.read_bytes())
    chips = write_chip_network(own)
    files = set(Models(Settings(detector=str(own))).files())
    assert {own, chips} <= files
    assert bundled_file("chips") not in files


def test_the_errors_of_the_bundled_detector_may_be_read_by_workers() -> None:
    assert bundled_file("vehicles").with_suffix(".errors.toml") in Models(Settings()).files()


def test_the_errors_of_an_own_detector_may_be_read_by_workers(
    detector_path: Path, tmp_path: Path
) -> None:
    own = tmp_path / "own.onnx"
    own.write_bytes(detector_path.read_bytes())
    errors = tmp_path / "own.errors.toml"
    errors.write_text("[boxes]\nlog_sd = 0.2\n")
    assert errors in Models(Settings(detector=str(own))).files()


def test_a_missing_detector_has_no_networks_beside_the_segmenter(
    segmenter_paths: SamFiles, tmp_path: Path
) -> None:
    encoder, decoder = (tmp_path / Path(path).name for path in segmenter_paths)
    for path, copy in zip(segmenter_paths, (encoder, decoder), strict=True):
        copy.write_bytes(Path(path).read_bytes())
    stranger = write_chip_network(encoder)
    files = Models(
        Settings(detector=str(tmp_path / "none.onnx"), segmenter=(encoder, decoder))
    ).files()
    assert encoder in files
    assert stranger not in files


def test_workers_do_without_the_sdk() -> None:
    modules = ["vehanchor_server.calls.worker_process", "vehanchor_server.resources", *SLOW_IMPORTS]
    script = f"import sys\nfor name in {modules}: __import__(name)\nprint('mcp' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", script], text=True) == "False\n", (
        "30 MB, and 0.3 s"
    )
