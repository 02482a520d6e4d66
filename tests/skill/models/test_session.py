from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from tests.models import write_detector, write_other_model
from tests.sam_models import keep_weights_beside, write_sam2
from vehanchor.errors import ModelContractError, ProviderUnavailableError
from vehanchor.models.runtime import Runtime
from vehanchor.models.session import _share_arena, open_session


def outputs(path: Path, content: bytes | None) -> list[np.ndarray]:
    session = open_session(path, content=content, runtime=Runtime(threads=1))
    feeds = {"pixel_values": np.ones((1, 3, 128, 128), np.float32), "image": np.ones((1, 3, 128, 128), np.float32)}
    asked = {item.name: feeds[item.name] for item in session.get_inputs()}
    return [np.asarray(value) for value in session.run(None, asked)]


def test_weights_in_a_file_beside_the_model_are_found_from_any_folder_and_whoever_read_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = write_sam2(tmp_path)[1]
    inside = [item.name for item in open_session(decoder, content=decoder.read_bytes()).get_inputs()]
    keep_weights_beside(decoder, ".weights")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for content in (None, decoder.read_bytes()):
        assert [item.name for item in open_session(decoder, content=content).get_inputs()] == inside


def test_bytes_that_were_read_already_are_what_is_run(tmp_path: Path) -> None:
    encoder = write_sam2(tmp_path)[0]
    content = encoder.read_bytes()
    before = outputs(encoder, None)
    write_other_model(encoder)
    for was, now in zip(before, outputs(encoder, content), strict=True):
        np.testing.assert_array_equal(was, now)


def test_an_arena_that_somebody_else_shares_already_serves(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def taken(*_: object) -> None:
        raise RuntimeError("an allocator for this device has been registered already")

    monkeypatch.setattr(onnxruntime, "create_and_register_allocator", taken)
    _share_arena.cache_clear()
    encoder = write_sam2(tmp_path)[0]
    assert len(outputs(encoder, encoder.read_bytes()))
    _share_arena.cache_clear()  # for the tests after this one


def test_what_cannot_be_loaded_is_our_error_that_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "text.onnx"
    path.write_text("no model")
    for content in (None, path.read_bytes()):
        with pytest.raises(ModelContractError, match=r"text\.onnx is not an ONNX model"):
            open_session(path, content=content)
    with pytest.raises(ProviderUnavailableError, match="AbacusExecutionProvider"):
        open_session(path, runtime=Runtime(providers=["AbacusExecutionProvider"]))


def test_providers_have_short_names_and_one_that_is_missing_gives_way_to_a_cpu_named_beside_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_detector(tmp_path / "m.onnx")
    assert open_session(path, runtime=Runtime(providers=["cpu"])).get_providers() == ["CPUExecutionProvider"]
    with pytest.raises(ProviderUnavailableError, match=r"no DmlExecutionProvider.*add cpu to the providers"):
        open_session(path, runtime=Runtime(providers=["DirectML"]))
    for _ in range(2):
        assert open_session(path, runtime=Runtime(providers=["coreml", "cpu"])).get_providers() == [
            "CPUExecutionProvider"
        ]
    said = [record.getMessage() for record in caplog.records]
    assert said == ["ONNX Runtime has no CoreMLExecutionProvider here: models run without"]


def test_a_provider_that_is_installed_and_does_not_start_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_detector(tmp_path / "m.onnx")
    available = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    opened = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: available)
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda *_, **__: opened)  # as where there is no driver
    assert open_session(path, runtime=Runtime(providers=["cuda"])) is opened
    assert "CUDAExecutionProvider cannot start here: models run on CPUExecutionProvider" in caplog.text
