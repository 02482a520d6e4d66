from __future__ import annotations

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


def outputs(path: Path, content: bytes | None) -> list[np.ndarray]:
    session = open_session(path, content=content, runtime=Runtime(threads=1))
    feeds = {
        "pixel_values": np.ones((1, 3, 128, 128), np.float32),
        "image": np.ones((1, 3, 128, 128), np.float32),
    }
    asked = {item.name: feeds[item.name] for item in session.get_inputs()}
    return [np.asarray(value) for value in session.run(None, asked)]


def test_weights_in_a_file_beside_the_model_are_found_from_any_folder_and_whoever_read_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = write_sam2(tmp_path)[1]
    inside = [
        item.name for item in open_session(decoder, content=decoder.read_bytes()).get_inputs()
    ]
    keep_weights_beside(decoder, ".weights")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for content in (None, decoder.read_bytes()):
        assert [item.name for item in open_session(decoder, content=content).get_inputs()] == inside


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
    assert open_session(path, runtime=Runtime(providers=["cpu"])).get_providers() == [
        "CPUExecutionProvider"
    ]
    with pytest.raises(
        ProviderUnavailableError, match=r"no DmlExecutionProvider.*add cpu to the providers"
    ):
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
    # as where there is no driver
    monkeypatch.setattr(onnxruntime, "InferenceSession", lambda *_, **__: opened)
    assert open_session(path, runtime=Runtime(providers=["cuda"])) is opened
    assert (
        "CUDAExecutionProvider cannot start here: models run on CPUExecutionProvider" in caplog.text
    )


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, list[str]]]:
    """The providers that each model file was to run on, as on a machine with a GPU; they run on the CPU."""
    real = onnxruntime.InferenceSession
    asked = {}

    def open_on_cpu(source: Any, options: Any, *, providers: list[str]) -> Any:
        on_cpu = real(source, options, providers=["CPUExecutionProvider"])
        asked[" ".join(each.name for each in (*on_cpu.get_inputs(), *on_cpu.get_outputs()))] = (
            providers
        )
        return on_cpu

    monkeypatch.setattr(onnxruntime, "InferenceSession", open_on_cpu)
    monkeypatch.setattr(
        onnxruntime,
        "get_available_providers",
        lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"],
    )
    yield asked
    session._warn_once.cache_clear()  # another test wants to hear it, too


@pytest.mark.slow
def test_every_bundled_model_of_a_verb_runs_where_its_caller_says(
    opened: dict[str, list[str]],
) -> None:
    image = render_scene(0.12, width_px=400, height_px=320, seed=3).image
    vehanchor.measure_area(image, box=(20, 20, 80, 80), providers=["cuda", "cpu"])
    assert len(opened) == 7, (
        "the detector, the verifier, the chips, the ground, the courts, the segmenter's halves"
    )
    assert set(map(tuple, opened.values())) == {("CUDAExecutionProvider", "CPUExecutionProvider")}
    opened.clear()
    vehanchor.measure_distance(image, [(20, 20), (80, 80)], providers="cuda")
    assert opened
    assert set(map(tuple, opened.values())) == {("CUDAExecutionProvider",)}


def test_providers_are_a_list_a_name_or_nothing() -> None:
    assert (
        Runtime().providers
        == Runtime().with_keywords({"providers": None}).providers
        == DEFAULT_PROVIDERS
    )
    assert Runtime(providers="cuda").providers == ("cuda",)
    assert Runtime(providers=["cuda", "cpu"]).providers == ("cuda", "cpu")
    for wrong in ([], [1], [None]):
        with pytest.raises(InvalidParameterError, match=r"name them, as in \['cuda', 'cpu'\]"):
            Runtime(providers=wrong)  # type: ignore[arg-type]


_IMAGE = np.zeros((128, 128, 3), np.uint8)


def _model(
    path: Path, nodes: list[Any], weights: dict[str, Any], shape: list[Any], **metadata: str
) -> Path:
    graph = helper.make_graph(
        nodes,
        "hostile",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, "h", "w"])],
        [helper.make_tensor_value_info("boxes", TensorProto.FLOAT, shape)],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    for key, value in metadata.items():
        model.metadata_props.add(key=key.replace("__", "."), value=value)
    onnx.save(model, str(path))
    return path


def _always(path: Path, rows: Any, n_rows: int = 1) -> Path:
    """A detector that puts out the same rows for every image, as often as asked."""
    nodes = [helper.make_node("Expand", ["rows", "shape"], ["boxes"])]
    table = np.asarray(rows, np.float32).reshape(1, -1, 7)
    shape = np.asarray([1, max(n_rows, table.shape[1]), 7])
    return _model(path, nodes, {"rows": table, "shape": shape}, [1, "n", 7], names="{0: 'car'}")


@pytest.mark.parametrize("side", [1e30, 1e6, np.inf, np.nan, 3e38])
def test_boxes_larger_than_the_image_are_no_vehicles(tmp_path: Path, side: float) -> None:
    rows = [[64 + i, 64, side, side / 2, 0.95, 0, 0.1 * i] for i in range(30)]
    found = estimate_gsd(_IMAGE, detector=_always(tmp_path / "m.onnx", rows))
    assert found.status == "no_scale"
    assert found.confidence == 0


@pytest.mark.parametrize("class_index", [np.nan, 1e30, -1e30])
def test_a_class_that_is_no_number_is_no_vehicle(tmp_path: Path, class_index: float) -> None:
    rows = [[64, 64, 20, 10, 0.9, class_index, 0]]
    assert estimate_gsd(_IMAGE, detector=_always(tmp_path / "m.onnx", rows)).status == "no_scale"


def test_more_boxes_than_an_image_has_places_are_a_contract_error(tmp_path: Path) -> None:
    path = _always(tmp_path / "m.onnx", [[64, 64, 20, 10, 0.9, 0, 0]], n_rows=200_000)
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
    grid = np.zeros((1, 3, 128, 128), np.float32)
    weights = {"grid": grid, "zero": np.float32(0), "rows": np.zeros((1, 6, 7), np.float32)}
    path = _model(tmp_path / "m.onnx", nodes, weights, [1, "n", 7], names="{0: 'car'}")
    assert estimate_gsd(_IMAGE, detector=path).status == "no_scale"
    with pytest.raises(ModelContractError, match=r"fails on \[1, 3, 256, 256\]"):
        estimate_gsd(np.zeros((256, 256, 3), np.uint8), detector=path)


def test_a_fixed_input_of_absurd_size_is_refused_before_it_is_filled(tmp_path: Path) -> None:
    graph = helper.make_graph(
        [helper.make_node("Identity", ["images"], ["boxes"])],
        "huge",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 10**6, 10**6])],
        [helper.make_tensor_value_info("boxes", TensorProto.FLOAT, [1, "n", 7])],
    )
    path = tmp_path / "m.onnx"
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8),
        str(path),
    )
    with pytest.raises(ModelContractError, match="1000000 x 1000000 px"):
        Detector(path)


class _Session:
    def __init__(self, error: Exception) -> None:
        self._error = error

    def run(self, *_: Any) -> Any:
        raise self._error


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("std::bad_alloc"),
        RuntimeError("Failed to allocate memory for requested buffer"),
    ],
)
def test_want_of_memory_is_not_the_models_fault(error: Exception) -> None:
    with pytest.raises(OutOfMemoryError) as caught:
        run_session(_Session(error), None, feeds={}, runtime=Runtime(), described="the model fails")
    assert caught.value.code == "out_of_memory"
    with pytest.raises(ModelContractError):
        run_session(
            _Session(RuntimeError("Fail")),
            None,
            feeds={},
            runtime=Runtime(),
            described="the model fails",
        )


def test_a_cancelled_run_is_no_failure_of_the_model() -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    assert cancellation.run_options.terminate
    with pytest.raises(CancelledError, match="the call was cancelled"):
        run_session(
            _Session(RuntimeError("Exiting")),
            None,
            feeds={},
            runtime=Runtime(cancellation=cancellation),
            described="the model fails",
        )
