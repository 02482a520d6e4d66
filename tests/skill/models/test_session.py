from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

import vehanchor
from research.scenes import render_scene
from tests.models import write_detector
from tests.sam_models import keep_weights_beside, write_sam2
from vehanchor import estimate_gsd
from vehanchor.detection.boxes import oriented_nms
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    InvalidParameterError,
    ModelContractError,
    OutOfMemoryError,
    ProviderUnavailableError,
)
from vehanchor.models import session
from vehanchor.models.runtime import DEFAULT_PROVIDERS, Cancellation, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import resolve_model


def _input_names(path: Path, content: bytes | None) -> list[str]:
    return [tensor.name for tensor in open_session(path, content=content).get_inputs()]


@pytest.mark.parametrize("is_read", [False, True], ids=["by path", "by its bytes"])
def test_external_weights_are_found_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_read: bool
) -> None:
    decoder = write_sam2(tmp_path)[1]
    names = _input_names(decoder, decoder.read_bytes())
    keep_weights_beside(decoder, ".weights")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    content = decoder.read_bytes() if is_read else None
    assert _input_names(decoder, content) == names


@pytest.mark.parametrize("is_read", [False, True], ids=["by path", "by its bytes"])
def test_a_file_that_cannot_be_loaded_is_named(tmp_path: Path, is_read: bool) -> None:
    path = tmp_path / "text.onnx"
    path.write_text("no model")
    content = path.read_bytes() if is_read else None
    with pytest.raises(ModelContractError, match=r"text\.onnx is not an ONNX model"):
        open_session(path, content=content)


def test_a_session_keeps_no_bytes_of_its_file(model: Path) -> None:
    content = model.read_bytes()
    n_references = sys.getrefcount(content)
    opened = open_session(model, content=content)
    assert opened.get_inputs()
    assert sys.getrefcount(content) == n_references, (
        "ONNX Runtime keeps the bytes of each model, 9 MB in a process that estimates. In its "
        "onnxruntime_inference_collection.py find the attribute of InferenceSession that holds "
        "path_or_bytes, and clear that one in vehanchor.models.session._release_file"
    )


# --- Execution providers


def test_an_unknown_provider_is_named_before_the_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "text.onnx"
    path.write_text("no model")
    with pytest.raises(ProviderUnavailableError, match="AbacusExecutionProvider"):
        open_session(path, runtime=Runtime(providers=["AbacusExecutionProvider"]))


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_detector(tmp_path / "m.onnx")


def _providers(path: Path, *providers: str) -> list[str]:
    """Providers of a session that is opened with these."""
    used: list[str] = open_session(path, runtime=Runtime(providers=providers)).get_providers()
    return used


def test_providers_have_short_names(model: Path) -> None:
    assert _providers(model, "cpu") == ["CPUExecutionProvider"]


def test_a_missing_provider_is_refused(model: Path) -> None:
    with pytest.raises(
        ProviderUnavailableError, match=r"no DmlExecutionProvider.*add cpu to the providers"
    ):
        _providers(model, "DirectML")


def test_a_missing_provider_beside_the_cpu_is_skipped_with_one_warning(
    model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        assert _providers(model, "coreml", "cpu") == ["CPUExecutionProvider"]
    messages = [record.getMessage() for record in caplog.records]
    assert messages == ["ONNX Runtime has no CoreMLExecutionProvider here: models run without"]


def test_an_installed_provider_that_does_not_start_is_reported(
    model: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    available = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    on_cpu = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: available)
    # ONNX Runtime falls back to the CPU if there is no driver.
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda *_, **__: on_cpu)
    assert open_session(model, runtime=Runtime(providers=["cuda"])) is on_cpu
    warning = "CUDAExecutionProvider cannot start here: models run on CPUExecutionProvider"
    assert warning in caplog.text


_CUDA = "CUDAExecutionProvider"
_CPU = "CPUExecutionProvider"


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, list[str]]]:
    """Providers that each model file should run on, on a machine with a GPU; all run on the CPU."""
    real_session = onnxruntime.InferenceSession
    providers_of: dict[str, list[str]] = {}

    def open_on_cpu(source: Any, options: Any, *, providers: list[str]) -> Any:
        on_cpu = real_session(source, options, providers=[_CPU])
        tensors = [*on_cpu.get_inputs(), *on_cpu.get_outputs()]
        providers_of[" ".join(tensor.name for tensor in tensors)] = providers
        return on_cpu

    monkeypatch.setattr(onnxruntime, "InferenceSession", open_on_cpu)
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [_CUDA, _CPU])
    yield providers_of
    # Another test waits for the warning, too.
    session._warn_once.cache_clear()


@pytest.fixture(scope="module")
def street() -> np.ndarray:
    return render_scene(0.12, width_px=400, height_px=320, seed=3).image


@pytest.mark.slow
def test_every_bundled_model_runs_on_the_callers_providers(
    opened: dict[str, list[str]], street: np.ndarray
) -> None:
    vehanchor.measure_area(street, box=(20, 20, 80, 80), providers=["cuda", "cpu"])
    bundled = resolve_model().parent.glob("*.onnx")
    assert len(opened) == len(list(bundled))
    assert set(map(tuple, opened.values())) == {(_CUDA, _CPU)}


@pytest.mark.slow
def test_a_single_provider_may_be_a_name(opened: dict[str, list[str]], street: np.ndarray) -> None:
    vehanchor.measure_distance(street, [(20, 20), (80, 80)], providers="cuda")
    assert opened
    assert set(map(tuple, opened.values())) == {(_CUDA,)}


def test_no_choice_of_providers_is_the_default() -> None:
    assert Runtime().providers == DEFAULT_PROVIDERS
    assert Runtime().with_keywords({"providers": None}).providers == DEFAULT_PROVIDERS


def test_providers_are_a_list_or_a_name() -> None:
    assert Runtime(providers="cuda").providers == ("cuda",)
    assert Runtime(providers=["cuda", "cpu"]).providers == ("cuda", "cpu")


@pytest.mark.parametrize("providers", [[], [1], [None]])
def test_providers_without_names_are_refused(providers: Any) -> None:
    with pytest.raises(InvalidParameterError, match=r"name them, as in \['cuda', 'cpu'\]"):
        Runtime(providers=providers)


# --- Models with hostile outputs


_IMAGE = np.zeros((128, 128, 3), np.uint8)


def _model(
    path: Path, nodes: list[Any], weights: dict[str, Any], shape: list[Any], **metadata: str
) -> Path:
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, "h", "w"])
    boxes = helper.make_tensor_value_info("boxes", TensorProto.FLOAT, shape)
    constants = [
        numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()
    ]
    graph = helper.make_graph(nodes, "hostile", [images], [boxes], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    for key, value in metadata.items():
        model.metadata_props.add(key=key.replace("__", "."), value=value)
    onnx.save(model, str(path))
    return path


def _with_constant_rows(path: Path, rows: Any, n_rows: int = 1) -> Path:
    """A detector that returns the same rows for every image, repeated ``n_rows`` times."""
    nodes = [helper.make_node("Expand", ["rows", "shape"], ["boxes"])]
    table = np.asarray(rows, np.float32).reshape(1, -1, 7)
    shape = np.asarray([1, max(n_rows, table.shape[1]), 7])
    weights = {"rows": table, "shape": shape}
    return _model(path, nodes, weights=weights, shape=[1, "n", 7], names="{0: 'car'}")


@pytest.mark.parametrize("side", [1e30, 1e6, np.inf, np.nan, 3e38])
def test_boxes_larger_than_the_image_are_not_vehicles(tmp_path: Path, side: float) -> None:
    rows = [[64 + i, 64, side, side / 2, 0.95, 0, 0.1 * i] for i in range(30)]
    estimate = estimate_gsd(_IMAGE, detector=_with_constant_rows(tmp_path / "m.onnx", rows))
    assert estimate.status == "no_scale"
    assert estimate.confidence == 0


@pytest.mark.parametrize("class_index", [np.nan, 1e30, -1e30])
def test_an_object_of_an_impossible_class_is_not_a_vehicle(
    tmp_path: Path, class_index: float
) -> None:
    rows = [[64, 64, 20, 10, 0.9, class_index, 0]]
    detector = _with_constant_rows(tmp_path / "m.onnx", rows)
    assert estimate_gsd(_IMAGE, detector=detector).status == "no_scale"


def test_more_boxes_than_fit_an_image_are_a_contract_error(tmp_path: Path) -> None:
    path = _with_constant_rows(tmp_path / "m.onnx", [[64, 64, 20, 10, 0.9, 0, 0]], n_rows=200_000)
    with pytest.raises(ModelContractError, match="200000 boxes for 128 x 128 px"):
        estimate_gsd(_IMAGE, detector=path)


def test_boxes_all_in_one_place_are_refused_before_their_pairs_are_counted() -> None:
    boxes = np.tile([500.0, 500.0, 20.0, 10.0, 0.3], (20_000, 1))
    with pytest.raises(ModelContractError, match="20000 boxes"):
        oriented_nms(boxes, np.linspace(0, 1, len(boxes)))


def test_a_graph_that_fails_on_a_tile_is_a_contract_error(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Add", ["images", "grid"], ["sum"]),
        helper.make_node("ReduceMax", ["sum"], ["most"], keepdims=0),
        helper.make_node("Mul", ["most", "zero"], ["nothing"]),
        helper.make_node("Add", ["rows", "nothing"], ["boxes"]),
    ]
    weights = {
        "grid": np.zeros((1, 3, 128, 128), np.float32),
        "zero": np.float32(0),
        "rows": np.zeros((1, 6, 7), np.float32),
    }
    path = _model(
        tmp_path / "m.onnx", nodes, weights=weights, shape=[1, "n", 7], names="{0: 'car'}"
    )
    assert estimate_gsd(_IMAGE, detector=path).status == "no_scale"
    with pytest.raises(ModelContractError, match=r"fails on \[1, 3, 256, 256\]"):
        estimate_gsd(np.zeros((256, 256, 3), np.uint8), detector=path)


def test_a_fixed_input_of_absurd_size_is_refused_before_it_is_filled(tmp_path: Path) -> None:
    side = 10**6
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, side, side])
    boxes = helper.make_tensor_value_info("boxes", TensorProto.FLOAT, [1, "n", 7])
    nodes = [helper.make_node("Identity", ["images"], ["boxes"])]
    graph = helper.make_graph(nodes, "huge", [images], [boxes])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = tmp_path / "m.onnx"
    onnx.save(model, str(path))
    with pytest.raises(ModelContractError, match="1000000 x 1000000 px"):
        Detector(path)


# --- Runs that fail


class _Session:
    """A session whose runs raise an error."""

    def __init__(self, error: Exception) -> None:
        self._error = error

    def run(self, *_: Any) -> Any:
        raise self._error


def _fail(error: Exception, runtime: Runtime | None = None) -> None:
    """Run a session that raises an error."""
    run_session(
        _Session(error),
        None,
        feeds={},
        runtime=runtime or Runtime(),
        described="the model fails",
    )


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("std::bad_alloc"),
        RuntimeError("Failed to allocate memory for requested buffer"),
    ],
)
def test_a_lack_of_memory_is_not_the_models_fault(error: Exception) -> None:
    with pytest.raises(OutOfMemoryError) as caught:
        _fail(error)
    assert caught.value.code == "out_of_memory"


def test_another_failure_is_a_contract_error() -> None:
    with pytest.raises(ModelContractError):
        _fail(RuntimeError("Fail"))


def test_a_cancelled_run_is_not_a_failure_of_the_model() -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    assert cancellation.run_options.terminate
    with pytest.raises(CancelledError, match="the call was cancelled"):
        _fail(RuntimeError("Exiting"), Runtime(cancellation=cancellation))
