from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from onnx.external_data_helper import set_external_data

from tests.sam_models import keep_weights_beside, write_sam2
from vehanchor.errors import ModelContractError, ModelNotFoundError
from vehanchor.models.files import external_locations, models_sha256, read_model
from vehanchor.models.zoo import bundled_models, bundled_segmenter

if TYPE_CHECKING:
    from pathlib import Path


def outside(name: str, location: str) -> onnx.TensorProto:
    tensor = numpy_helper.from_array(np.ones(300, np.float32), name)
    set_external_data(tensor, location=location)
    tensor.ClearField("raw_data")
    return tensor


def test_weights_are_found_wherever_a_graph_can_hold_a_tensor() -> None:
    constant = helper.make_node("Constant", [], ["c"], value=outside("c", "constant.bin"))
    several = helper.make_node("Custom", [], ["d"], domain="x", many=[outside("d", "one.bin"), outside("e", "two.bin")])
    branch = helper.make_graph([], "branch", [], [], [outside("f", "branch.bin")])
    choice = helper.make_node("If", ["condition"], ["g"], then_branch=branch, else_branch=branch)
    sparse = helper.make_sparse_tensor(outside("h", "sparse.bin"), numpy_helper.from_array(np.arange(300), "i"), [400])
    graph = helper.make_graph([constant, several, choice], "g", [], [], [outside("w", "main.bin")])
    graph.sparse_initializer.append(sparse)
    function = helper.make_function("x", "F", [], ["y"], [constant], [helper.make_opsetid("", 18)])
    function.node[0].attribute[0].t.external_data[0].value = "füße.bin"
    model = helper.make_model(graph, functions=[function])
    expected = {"constant.bin", "one.bin", "two.bin", "branch.bin", "sparse.bin", "main.bin", "füße.bin"}
    assert set(external_locations(model.SerializeToString())) == expected


def test_the_checksum_covers_graph_and_weights_in_their_order(tmp_path: Path) -> None:
    encoder, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder, ".weights")
    models = read_model(encoder), read_model(decoder)
    assert models[0].weights == ()
    assert models[1].weights == (beside,)
    joined = encoder.read_bytes() + decoder.read_bytes() + beside.read_bytes()
    assert models_sha256(*models) == hashlib.sha256(joined).hexdigest()


def test_missing_files_are_told_by_name(tmp_path: Path) -> None:
    _, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder)
    beside.unlink()
    with pytest.raises(ModelNotFoundError, match=rf"{beside.name}, which is missing"):
        read_model(decoder)
    for path in (tmp_path / "absent.onnx", tmp_path):
        with pytest.raises(ModelNotFoundError, match="no model file"):
            read_model(path)


def test_a_file_that_cannot_be_read_is_no_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, _ = write_sam2(tmp_path)

    def refuse(_path: Path) -> Any:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(encoder), "read_bytes", refuse)
    with pytest.raises(ModelContractError, match="Permission denied"):
        read_model(encoder)


def test_the_bundled_models_keep_their_weights_in_their_file() -> None:
    for path in (*bundled_models().values(), *(bundled_segmenter() or ())):
        assert read_model(path).weights == ()
