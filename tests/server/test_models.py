from __future__ import annotations

import time
from pathlib import Path

import pytest

from vehanchor_server.errors import CallError
from vehanchor_server.models import Models
from vehanchor_server.settings import Settings


def test_a_model_is_loaded_once_and_in_the_background(detector_path: Path) -> None:
    models = Models(Settings(detector=str(detector_path), threads=1))
    assert not models.ready
    models.preload()
    deadline = time.monotonic() + 60
    while not models.ready and time.monotonic() < deadline:
        time.sleep(0.01)
    assert models.ready
    assert models.detector() is models.detector()


def test_a_model_that_appears_later_is_found(tmp_path: Path, detector_path: Path) -> None:
    path = tmp_path / "late.onnx"
    models = Models(Settings(detector=str(path), threads=1))
    with pytest.raises(CallError, match="model_unavailable"):
        models.detector()
    assert models.failure == "model_not_found"
    path.write_bytes(detector_path.read_bytes())
    assert models.detector().path == path
    assert models.failure is None
