"""A network in eight bits computes nearly what it did, and says the same of itself."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnx")

import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from research.training.eight_bits import write_eight_bits

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

pytestmark = pytest.mark.slow


@pytest.fixture
def network(tmp_path: Path) -> Path:
    """Two convolutions; the second is to stay as it is."""
    rng = np.random.default_rng(0)
    weights = {
        "first_w": rng.normal(0, 0.3, (8, 3, 3, 3)),
        "first_b": rng.normal(0, 0.1, 8),
        "last_w": rng.normal(0, 0.3, (2, 8, 1, 1)),
    }
    graph = helper.make_graph(
        [
            helper.make_node(
                "Conv", ["images", "first_w", "first_b"], ["raw"], name="first", pads=[1] * 4
            ),
            helper.make_node("Relu", ["raw"], ["seen"], name="relu"),
            helper.make_node("Conv", ["seen", "last_w"], ["out"], name="last"),
        ],
        "network",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 16, 16])],
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, [1, 2, 16, 16])],
        [
            numpy_helper.from_array(value.astype(np.float32), name)
            for name, value in weights.items()
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"vehanchor.name": "plain", "license": "Apache-2.0"})
    path = tmp_path / "plain.onnx"
    onnx.save(model, path)
    return path


def test_its_answers_stay_and_its_last_layer_keeps_its_weights(
    network: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng(1)
    batches: list[NDArray[np.float32]] = [
        rng.uniform(0, 1, (1, 3, 16, 16)).astype(np.float32) for _ in range(8)
    ]
    out = tmp_path / "small.onnx"
    write_eight_bits(
        network,
        out,
        batches=batches,
        nodes=lambda _model: ["first", "relu"],
        metadata={"vehanchor.name": "small"},
    )
    plain, small = (onnxruntime.InferenceSession(str(path)) for path in (network, out))
    before, after = (session.run(None, {"images": batches[0]})[0] for session in (plain, small))
    assert 0 < np.abs(after - before).max() < 0.03 * np.ptp(before)
    assert small.get_modelmeta().custom_metadata_map == {
        "vehanchor.name": "small",
        "license": "Apache-2.0",
    }
    arrays = {
        initializer.name: numpy_helper.to_array(initializer)
        for initializer in onnx.load(out).graph.initializer
    }
    (eight,) = (value for value in arrays.values() if value.dtype == np.int8 and value.ndim == 4)
    assert 0 < np.abs(eight).max() <= 64
    assert arrays["last_w"].dtype == np.float32
