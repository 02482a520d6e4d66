from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import pytest
from onnx.external_data_helper import set_external_data

from tests.models import blank_image, paint_vehicles, write_detector, write_fleet_network, write_other_model
from vehanchor.detection.appearance import FleetLengths
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.search import search
from vehanchor.errors import (
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Search

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_DOTA = {
    0: "plane", 1: "ship", 2: "storage tank", 3: "baseball diamond", 4: "tennis court", 5: "basketball court",
    6: "ground track field", 7: "harbor", 8: "bridge", 9: "large vehicle", 10: "small vehicle", 11: "helicopter",
    12: "roundabout", 13: "soccer ball field", 14: "swimming pool",
}  # fmt: skip
_TWO = {0: "small_vehicle", 1: "large vehicle"}
_LENGTHS = FleetLengths((-1.0, 1.0), (4.0, 5.0), 0.3, 2.0)
_BOXES = np.array([[60.3, 50.7, 30, 12, 0.3], [150, 90, 28, 11, 1.9], [100.5, 200, 31, 12.5, 3.0]])


def _picture(boxes: NDArray[np.float64] = _BOXES, **kinds: Any) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    image = blank_image(256, 256)
    return image, paint_vehicles(image, boxes, **kinds)


def _assert_same(found: NDArray[np.float64], expected: NDArray[np.float64], within: float = 1e-3) -> None:
    assert len(found) == len(expected)
    order = np.argmin(np.linalg.norm(found[:, None, :2] - expected[None, :, :2], axis=2), axis=0)
    np.testing.assert_allclose(found[order][:, :4], expected[:, :4], atol=within * 10)
    assert np.abs(np.sin(found[order][:, 4] - expected[:, 4])).max() < 10 * within


@pytest.mark.parametrize("fixed_size", [None, 256, 320])
@pytest.mark.parametrize(
    ("layout", "names"),
    [
        *((layout, names) for layout in ("raw", "end2end") for names in ({0: "small-vehicle"}, _DOTA, _TWO)),
        ("end2end", {3: "car"}),  # a raw export has a score for every class from 0 on
    ],
)
def test_every_layout_gives_the_painted_boxes(
    tmp_path: Path, layout: Any, fixed_size: int | None, names: dict[int, str]
) -> None:
    kind = next(i for i, name in names.items() if "small" in name or name == "car")
    image, painted = _picture(classes=[kind] * 3)
    detector = Detector(write_detector(tmp_path / "m.onnx", layout=layout, names=names, fixed_size=fixed_size))
    with open_raster(image) as raster:
        found = search(raster, detector)
    _assert_same(found.boxes, painted)
    np.testing.assert_allclose(found.scores, 0.9, atol=1 / 255)


def test_swapped_sides_and_unbounded_angles_are_the_same_boxes(tmp_path: Path) -> None:
    image, painted = _picture()
    path = write_detector(tmp_path / "m.onnx", swap_sides=True, angle_offset=-6 * np.pi)
    with open_raster(image) as raster:
        _assert_same(search(raster, Detector(path)).boxes, painted)


def test_other_classes_are_not_vehicles_unless_asked_for(tmp_path: Path) -> None:
    image, painted = _picture(classes=[10, 9, 0])
    path = write_detector(tmp_path / "m.onnx", names=_DOTA)

    def found(classes: list[str | int] | None) -> NDArray[np.float64]:
        with open_raster(image) as raster:
            return search(raster, Detector(path, classes=classes)).boxes

    _assert_same(found(None), painted[:1])
    _assert_same(found(["small-vehicle", "Large_Vehicle"]), painted[:2])
    _assert_same(found([0]), painted[2:])
    for unknown in ("bus", 15):
        with pytest.raises(InvalidParameterError, match=str(unknown)):
            found([unknown])


@pytest.mark.parametrize("layout", ["raw", "end2end"])
def test_a_tiles_other_objects_keep_their_class(tmp_path: Path, layout: Any) -> None:
    image, painted = _picture(classes=[10, 9, 0], scores=[0.9, 0.6, 0.3])
    path = write_detector(tmp_path / "m.onnx", names=_DOTA, layout=layout)
    detector = Detector(path)
    seen = detector.detect_tile(detector.prepared(image), 0.1)
    assert seen.vehicles.classes.tolist() == [10]
    _assert_same(seen.others.boxes, painted[1:])
    found = sorted(zip(seen.others.classes.tolist(), seen.others.scores.tolist(), strict=True))
    assert found == [(0, pytest.approx(0.3, abs=1 / 255)), (9, pytest.approx(0.6, abs=1 / 255))]
    both = Detector(path, classes=["small vehicle", "large vehicle"]).detect_tile(detector.prepared(image), 0.1)
    assert sorted(both.vehicles.classes.tolist()) == [9, 10]
    assert both.others.classes.tolist() == [0]


def test_fifteen_nameless_classes_are_taken_for_dota(tmp_path: Path) -> None:
    image, painted = _picture(classes=[10, 9, 10])
    detector = Detector(write_detector(tmp_path / "m.onnx", names=None, n_classes=15))
    with open_raster(image) as raster:
        _assert_same(search(raster, detector).boxes, painted[[0, 2]])


def test_scores_below_the_threshold_are_dropped(tmp_path: Path) -> None:
    image, _ = _picture(scores=[0.9, 0.3, 0.08])
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(image) as raster:
        assert len(search(raster, detector).boxes) == 2  # the paper's 0.1
        assert len(search(raster, detector, Search(min_score=0.05)).boxes) == 3
        assert len(search(raster, detector, Search(min_score=0.5)).boxes) == 1


def test_a_detector_with_its_weights_in_a_file_beside_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image, painted = _picture()
    path = write_detector(tmp_path / "m.onnx")
    alone = Detector(path).card.sha256
    model = onnx.load(str(path))
    for tensor in model.graph.initializer:
        if tensor.data_type == onnx.TensorProto.FLOAT:  # the shapes of tensors have to stay in the file
            set_external_data(tensor, location="m.onnx.data")
    onnx.save(model, str(path))
    monkeypatch.chdir(path.root)
    detector = Detector(path)
    with open_raster(image) as raster:
        _assert_same(search(raster, detector).boxes, painted)
    assert detector.card.sha256 != alone
    (tmp_path / "m.onnx.data").unlink()
    with pytest.raises(ModelNotFoundError, match=r"m\.onnx\.data"):
        Detector(path)


def test_files_that_are_no_such_model_say_what_was_found(tmp_path: Path) -> None:
    with pytest.raises(ModelNotFoundError, match="nowhere"):
        Detector(tmp_path / "nowhere.onnx")
    (tmp_path / "text.onnx").write_text("not a model")
    with pytest.raises(ModelContractError, match=r"text\.onnx"):
        Detector(tmp_path / "text.onnx")
    good = write_detector(tmp_path / "good.onnx").read_bytes()
    (tmp_path / "half.onnx").write_bytes(good[: len(good) // 2])
    with pytest.raises(ModelContractError, match=r"half\.onnx"):
        Detector(tmp_path / "half.onnx")
    with pytest.raises(ModelContractError, match=r"(?s)output.*\[.*3\].*Expected"):
        Detector(write_other_model(tmp_path / "classifier.onnx"))
    with pytest.raises(ModelContractError, match="ship, harbor"):
        Detector(write_detector(tmp_path / "boats.onnx", names={0: "ship", 1: "harbor"}))


def test_a_fleet_network_that_comes_changes_or_goes_is_noticed(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    assert load_detector(path).fleet is None
    network = write_fleet_network(path, _LENGTHS)
    assert load_detector(path).card.fleet_lengths == _LENGTHS
    write_fleet_network(path, _LENGTHS._replace(sd_m=0.125))
    assert load_detector(path).card.fleet_lengths == _LENGTHS._replace(sd_m=0.125)
    network.unlink()
    assert load_detector(path).fleet is None
