from __future__ import annotations

from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from vehanchor import estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.detection.nms import oriented_nms
from vehanchor.errors import ModelContractError, OutOfMemoryError
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.models.session import run_session

_IMAGE = np.zeros((128, 128, 3), np.uint8)


def _model(path: Path, nodes: list[Any], weights: dict[str, Any], shape: list[Any], **metadata: str) -> Path:
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
    path = _always(tmp_path / "m.onnx", [[64, 64, 20, 10, 0.9, 0, 0]], n_rows=1_000_000)
    with pytest.raises(ModelContractError, match="1000000 boxes for 128 x 128 px"):
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
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    with pytest.raises(ModelContractError, match="1000000 x 1000000 px"):
        Detector(path)


class _Session:
    def __init__(self, error: Exception) -> None:
        self._error = error

    def run(self, *_: Any) -> Any:
        raise self._error


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("std::bad_alloc"), RuntimeError("Failed to allocate memory for requested buffer")],
)
def test_want_of_memory_is_not_the_models_fault(error: Exception) -> None:
    with pytest.raises(OutOfMemoryError) as caught:
        run_session(_Session(error), None, {}, Runtime(), "the model fails")
    assert caught.value.code == "out_of_memory"
    with pytest.raises(ModelContractError):
        run_session(_Session(RuntimeError("Fail")), None, {}, Runtime(), "the model fails")


def test_a_cancelled_run_is_no_failure_of_the_model() -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    assert cancellation.run_options.terminate
    with pytest.raises(CancelledError, match="the call was cancelled"):
        run_session(_Session(RuntimeError("Exiting")), None, {}, Runtime(cancellation=cancellation), "the model fails")
