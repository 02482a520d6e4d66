from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from onnx.external_data_helper import set_external_data

from tests.models import write_detector, write_other_model
from tests.sam_models import keep_weights_beside, write_sam2
from vehanchor import Engine
from vehanchor.detection import detector as detector_module
from vehanchor.detection.detector import load_detector, networks_sha256
from vehanchor.errors import ModelNotFoundError
from vehanchor.models import zoo
from vehanchor.models.files import external_locations, file_cached, models_sha256, read_model
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import (
    BUNDLED_MODELS,
    DEFAULT_DETECTOR,
    BundledModel,
    auxiliary_model,
    bundled_models,
    resolve_model,
    resolve_segmenter,
)


def outside(name: str, location: str) -> onnx.TensorProto:
    """A tensor whose values are in another file."""
    tensor = numpy_helper.from_array(np.ones(300, np.float32), name)
    set_external_data(tensor, location=location)
    tensor.ClearField("raw_data")
    return tensor


def test_external_weights_are_found_wherever_a_graph_holds_a_tensor() -> None:
    constant = helper.make_node("Constant", [], ["c"], value=outside("c", "constant.bin"))
    several = helper.make_node(
        "Custom", [], ["d"], domain="x", many=[outside("d", "one.bin"), outside("e", "two.bin")]
    )
    branch = helper.make_graph([], "branch", [], [], [outside("f", "branch.bin")])
    choice = helper.make_node("If", ["condition"], ["g"], then_branch=branch, else_branch=branch)
    sparse = helper.make_sparse_tensor(
        outside("h", "sparse.bin"), numpy_helper.from_array(np.arange(300), "i"), [400]
    )
    graph = helper.make_graph([constant, several, choice], "g", [], [], [outside("w", "main.bin")])
    graph.sparse_initializer.append(sparse)
    function = helper.make_function("x", "F", [], ["y"], [constant], [helper.make_opsetid("", 18)])
    function.node[0].attribute[0].t.external_data[0].value = "füße.bin"
    model = helper.make_model(graph, functions=[function])
    expected = {
        "constant.bin",
        "one.bin",
        "two.bin",
        "branch.bin",
        "sparse.bin",
        "main.bin",
        "füße.bin",
    }
    model.metadata_props.add(key="location", value="of the photographs")
    assert set(external_locations(model.SerializeToString())) == expected


def test_the_checksum_covers_graphs_with_their_weights_in_order(tmp_path: Path) -> None:
    encoder, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder, ".weights")
    models = read_model(encoder), read_model(decoder)
    assert models[0].weights == ()
    assert models[1].weights == (beside,)
    joined = encoder.read_bytes() + decoder.read_bytes() + beside.read_bytes()
    assert models_sha256(*models) == hashlib.sha256(joined).hexdigest()


def test_missing_weights_are_named(tmp_path: Path) -> None:
    _, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder)
    beside.unlink()
    with pytest.raises(ModelNotFoundError, match=rf"{beside.name}, which is missing"):
        read_model(decoder)


@pytest.mark.parametrize("name", ["absent.onnx", "."])
def test_a_path_without_a_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(ModelNotFoundError, match="no model file"):
        read_model(tmp_path / name)


# --- Cache


class Loaded:
    """A stand-in for a model, with the bytes of its file."""

    def __init__(self, path: Path, threads: int | None) -> None:
        self.content = read_model(path).content
        self.threads = threads


@file_cached(max_models=2)
def load(
    path: Path, *, threads: int | None = None, providers: tuple[str, ...] = ("CPU",)
) -> Loaded:
    del providers
    return Loaded(path, threads)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.onnx"
    path.write_bytes(b"first")
    return path


def test_a_file_is_loaded_once_for_each_set_of_options(model: Path) -> None:
    first = load(model)
    assert load(model) is first
    assert load(model, threads=1) is not first
    assert load(model, threads=1) is load(model, threads=1)


def test_a_replaced_file_is_loaded_anew(model: Path) -> None:
    before = load(model)
    # The other file has the same size and time.
    other = model.with_name("other")
    other.write_bytes(b"other")
    os.utime(other, ns=(model.stat().st_mtime_ns, model.stat().st_mtime_ns))
    other.replace(model)
    after = load(model)
    assert (before.content, after.content) == (b"first", b"other")
    assert load(model) is after


def test_a_relative_path_is_another_file_in_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.onnx").write_text(name)
    models = []
    for name in ("a", "b", "a"):
        monkeypatch.chdir(tmp_path / name)
        models.append(load(Path("model.onnx")))
    assert [model.content for model in models] == [b"a", b"b", b"a"]
    assert models[2] is models[0]
    assert load(tmp_path / "a" / "model.onnx") is models[0]


def test_other_weights_beside_the_file_are_loaded_anew(tmp_path: Path) -> None:
    _, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder, ".weights")
    first = load(decoder)
    assert load(decoder) is first
    beside.write_bytes(beside.read_bytes() + b"\0")
    assert load(decoder) is not first


def test_a_failure_is_not_cached(tmp_path: Path) -> None:
    path = tmp_path / "late.onnx"
    with pytest.raises(ModelNotFoundError):
        load(path)
    path.write_bytes(b"here now")
    assert load(path).content == b"here now"


# --- Bundled models


@pytest.fixture
def bundled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installation's folder of models with one of each kind, and a second detector."""
    folder = tmp_path / "bundled"
    folder.mkdir()
    for name in ("vehicles", "boats", "chips", "segmenter-encoder"):
        (folder / f"{name}.onnx").touch()
    (folder / "vehicles.md").touch()
    monkeypatch.setattr(zoo, "_BUNDLED", folder)
    return folder


def test_only_detectors_are_listed(bundled: Path) -> None:
    assert bundled_models() == {
        "boats": bundled / "boats.onnx",
        "vehicles": bundled / "vehicles.onnx",
    }


def test_this_installation_has_a_detector_of_the_default_name() -> None:
    assert resolve_model() == bundled_models()[DEFAULT_DETECTOR]
    assert resolve_model(DEFAULT_DETECTOR) == resolve_model()
    assert resolve_model().is_file()


def test_a_bundled_detector_is_found_by_its_name(bundled: Path) -> None:
    assert resolve_model("boats") == bundled / "boats.onnx"


def test_a_detector_is_found_by_its_path(bundled: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.onnx"
    own.touch()
    assert resolve_model(own) == resolve_model(str(own)) == own


@pytest.mark.parametrize("name", ["chips", "segmenter-encoder", "absent.onnx", "."])
def test_any_other_name_is_refused_with_the_bundled_detectors(
    bundled: Path, tmp_path: Path, name: str
) -> None:
    if name in ("absent.onnx", "."):
        name = str(tmp_path / name)
    with pytest.raises(ModelNotFoundError, match=r"bundled detectors \(boats, vehicles\)"):
        resolve_model(name)


def test_the_chip_network_of_the_default_detector_is_bundled(bundled: Path) -> None:
    assert auxiliary_model(bundled / "vehicles.onnx", "chips") == bundled / "chips.onnx"
    assert auxiliary_model(bundled / "boats.onnx", "chips") is None
    (bundled / "chips.onnx").unlink()
    assert auxiliary_model(bundled / "vehicles.onnx", "chips") is None


def test_the_chip_network_of_another_detector_lies_beside_it(tmp_path: Path) -> None:
    own = tmp_path / "own.onnx"
    assert auxiliary_model(own, "chips") is None
    (tmp_path / "own.chips.onnx").touch()
    assert auxiliary_model(own, "chips") == tmp_path / "own.chips.onnx"


def test_this_installation_has_a_segmenter() -> None:
    assert all(path.is_file() for path in resolve_segmenter())


def test_a_segmenter_is_found_by_both_its_paths(tmp_path: Path) -> None:
    encoder = tmp_path / "encoder.onnx"
    decoder = tmp_path / "decoder.onnx"
    encoder.touch()
    with pytest.raises(ModelNotFoundError, match=r"decoder\.onnx"):
        resolve_segmenter((encoder, decoder))
    decoder.touch()
    assert resolve_segmenter((str(encoder), decoder)) == (encoder, decoder)


def test_every_bundled_file_is_in_the_list() -> None:
    (folder,) = {model.path.parent for model in BUNDLED_MODELS}
    assert {model.file for model in BUNDLED_MODELS} == {path.name for path in folder.glob("*.onnx")}


# --- A model that is added to the list

LOADED: list[Runtime] = []
"""Runtimes for which the added model was loaded."""


def load_added(runtime: Runtime) -> None:
    LOADED.append(runtime)


@pytest.fixture
def added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> BundledModel:
    """A network of a ruler that is added to the list of bundled models."""
    path = write_other_model(tmp_path / "added.onnx")
    loader = f"{__name__}:load_added"
    # An absolute path replaces the folder of bundled models.
    model = BundledModel(name="added", file=str(path), role="ruler", loader=loader)
    for module in (zoo, detector_module):
        monkeypatch.setattr(module, "BUNDLED_MODELS", (*BUNDLED_MODELS, model))
    LOADED.clear()
    return model


def test_an_added_model_has_a_file(added: BundledModel) -> None:
    assert zoo.bundled_file("added") == added.path


def test_an_added_model_is_loaded_by_an_engine(added: BundledModel) -> None:
    one_thread = Runtime(threads=1)
    Engine(runtime=one_thread).load()
    assert [one_thread] == LOADED


def test_an_added_model_makes_results_stale(tmp_path: Path, added: BundledModel) -> None:
    card = load_detector(write_detector(tmp_path / "m.onnx")).card
    before = networks_sha256(card)
    write_other_model(added.path, metadata={"version": "2"})
    assert networks_sha256(card) != before


def test_the_checksum_of_the_networks_is_made_as_before() -> None:
    """Otherwise the results of earlier builds would be stale although no network has changed."""
    card = load_detector(resolve_model()).card
    sums = {
        name: hashlib.sha256(zoo.bundled_file(name).read_bytes()).hexdigest()
        for name in ("vehicles", "verifier", "chips", "scene-scale", "courts")
    }
    detectors = "".join(f"{sums[name]}\n" for name in ("vehicles", "verifier", "chips"))
    text = detectors + sums["scene-scale"] + sums["courts"] + f"{card.errors.sha256}\n"
    assert networks_sha256(card) == hashlib.sha256(text.encode()).hexdigest()
