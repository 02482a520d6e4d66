from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.models import blank_image, paint_vehicles, write_detector, write_other_model
from vehanchor.detection.boxes import oriented_iou
from vehanchor.detection.detector import (
    LENGTH_RANGE_PX,
    MIN_SCORE,
    REFERENCE_LENGTH_M,
    Detector,
    detect_vehicles,
    load_detector,
)
from vehanchor.errors import (
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
    ProviderUnavailableError,
)
from vehanchor.imagery.raster import open_raster

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_DOTA = {
    0: "plane", 1: "ship", 2: "storage tank", 3: "baseball diamond", 4: "tennis court", 5: "basketball court",
    6: "ground track field", 7: "harbor", 8: "bridge", 9: "large vehicle", 10: "small vehicle", 11: "helicopter",
    12: "roundabout", 13: "soccer ball field", 14: "swimming pool",
}  # fmt: skip
_TWO = {0: "small_vehicle", 1: "large vehicle"}
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
        found = detect_vehicles(raster, detector)
    _assert_same(found.boxes, painted)
    np.testing.assert_allclose(found.scores, 0.9, atol=1 / 255)


def test_half_precision_exports_work(tmp_path: Path) -> None:
    image, painted = _picture()
    detector = Detector(write_detector(tmp_path / "m.onnx", dtype="float16"))
    with open_raster(image) as raster:
        _assert_same(detect_vehicles(raster, detector).boxes, painted, within=2e-2)


def test_swapped_sides_and_unbounded_angles_are_the_same_boxes(tmp_path: Path) -> None:
    image, painted = _picture()
    path = write_detector(tmp_path / "m.onnx", swap_sides=True, angle_offset=-6 * np.pi)
    with open_raster(image) as raster:
        _assert_same(detect_vehicles(raster, Detector(path)).boxes, painted)


def test_other_classes_are_not_vehicles_unless_asked_for(tmp_path: Path) -> None:
    image, painted = _picture(classes=[10, 9, 0])
    path = write_detector(tmp_path / "m.onnx", names=_DOTA)

    def found(classes: list[str | int] | None) -> NDArray[np.float64]:
        with open_raster(image) as raster:
            return detect_vehicles(raster, Detector(path, classes=classes)).boxes

    _assert_same(found(None), painted[:1])
    _assert_same(found(["small-vehicle", "Large_Vehicle"]), painted[:2])
    _assert_same(found([0]), painted[2:])
    for unknown in ("bus", 15):
        with pytest.raises(InvalidParameterError, match=str(unknown)):
            found([unknown])


def test_fifteen_nameless_classes_are_taken_for_dota(tmp_path: Path) -> None:
    image, painted = _picture(classes=[10, 9, 10])
    detector = Detector(write_detector(tmp_path / "m.onnx", names=None, n_classes=15))
    with open_raster(image) as raster:
        _assert_same(detect_vehicles(raster, detector).boxes, painted[[0, 2]])


def test_scores_below_the_threshold_are_dropped(tmp_path: Path) -> None:
    image, _ = _picture(scores=[0.9, 0.3, 0.08])
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(image) as raster:
        assert len(detect_vehicles(raster, detector).boxes) == 2  # the paper's 0.1
        assert len(detect_vehicles(raster, detector, min_score=0.05).boxes) == 3
        assert len(detect_vehicles(raster, detector, min_score=0.5).boxes) == 1


def _street(width: int, height: int, seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    image = blank_image(width, height)
    grid = np.stack(np.meshgrid(np.arange(40, width - 40, 60), np.arange(40, height - 40, 60)), axis=-1).reshape(-1, 2)
    n = len(grid)
    boxes = np.column_stack(
        [grid + rng.uniform(-5, 5, grid.shape), rng.normal(30, 2, n), rng.normal(12, 0.5, n), rng.uniform(0, np.pi, n)]
    )
    return image, paint_vehicles(image, boxes)


@pytest.mark.parametrize(("width", "height", "tile"), [(700, 500, 256), (513, 300, 256), (300, 900, 320)])
def test_tiles_find_each_vehicle_once_in_image_coordinates(tmp_path: Path, width: int, height: int, tile: int) -> None:
    image, painted = _street(width, height)
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(image) as raster:
        found = detect_vehicles(raster, detector, tile_px=tile)
    _assert_same(found.boxes, painted)
    assert found.n_tiles > 1


def test_a_model_of_fixed_size_sets_the_tile_and_pads_small_images(tmp_path: Path) -> None:
    image, painted = _street(400, 200)
    detector = Detector(write_detector(tmp_path / "m.onnx", fixed_size=320))
    with open_raster(image) as raster:
        _assert_same(detect_vehicles(raster, detector).boxes, painted)
        with pytest.raises(InvalidParameterError, match="fixed"):
            detect_vehicles(raster, detector, tile_px=1024)


def test_a_tile_whose_rows_ran_out_is_counted(tmp_path: Path) -> None:
    image, painted = _street(400, 400)
    detector = Detector(write_detector(tmp_path / "m.onnx", layout="end2end", cap=20))
    with open_raster(image) as raster:
        found = detect_vehicles(raster, detector)
    assert len(painted) > len(found.boxes) == 20
    assert (found.n_tiles, found.n_capped_tiles) == (1, 1)


def test_overlapping_boxes_of_one_vehicle_are_merged(tmp_path: Path) -> None:
    boxes = np.array([[60.5, 60.5, 30, 12, 0.3], [60.5, 64.2, 30, 12, 0.3], [150, 60, 30, 12, 0.3]])
    image, _ = _picture(boxes, scores=[0.9, 0.8, 0.7])
    with open_raster(image) as raster:
        detector = Detector(write_detector(tmp_path / "m.onnx"))
        merged = detect_vehicles(raster, detector)
        every = detect_vehicles(raster, detector, nms_iou=1.0)
    assert oriented_iou(boxes[:1], boxes[1:2])[0, 0] > 0.45
    assert (len(merged.boxes), len(every.boxes)) == (2, 3)


def test_progress_counts_tiles_and_may_stop_the_search(tmp_path: Path) -> None:
    image, _ = _street(700, 500)
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    seen: list[tuple[int, int]] = []
    with open_raster(image) as raster:
        detect_vehicles(raster, detector, tile_px=256, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k, len(seen) - 1) for k in range(len(seen))]

    def stop(done: int, total: int) -> None:
        raise TimeoutError

    with open_raster(image) as raster, pytest.raises(TimeoutError):
        detect_vehicles(raster, detector, progress=stop)


@pytest.mark.parametrize("options", [{"tile_px": 16}, {"stride_px": 0}, {"tile_px": 256, "stride_px": 257}])
def test_tiles_without_meaning_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(blank_image(300, 300)) as raster, pytest.raises(InvalidParameterError, match="tile"):
        detect_vehicles(raster, detector, **options)


def test_the_card_reads_our_metadata(tmp_path: Path) -> None:
    metadata = {
        "vehanchor.name": "mine",
        "vehanchor.reference_length_m": "4.6",
        "vehanchor.reference_length_sd_m": "0.3",
        "vehanchor.length_range_px": "9,64",
        "vehanchor.min_length_px": "13",
        "vehanchor.min_score": "0.35",
        "vehanchor.region_lengths_m": '{"asia": 4.3}',
        "license": "Apache-2.0",
    }
    card = Detector(write_detector(tmp_path / "m.onnx", metadata=metadata)).card
    assert (card.name, card.reference_length_m, card.reference_length_sd_m) == ("mine", 4.6, 0.3)
    assert (card.length_range_px, card.min_length_px, card.min_score) == ((9.0, 64.0), 13.0, 0.35)
    assert card.region_lengths_m["asia"] == 4.3
    assert card.region_lengths_m["europe"] == pytest.approx(4.6 * 4.5 / 5.045)
    assert card.licence == "Apache-2.0"


def test_a_foreign_model_gets_the_papers_values(tmp_path: Path) -> None:
    card = Detector(write_detector(tmp_path / "foreign.onnx")).card
    assert (card.name, card.reference_length_m, card.min_score) == ("foreign", REFERENCE_LENGTH_M, MIN_SCORE)
    assert card.reference_length_m == 5.045
    assert card.length_range_px == LENGTH_RANGE_PX
    assert card.min_length_px == 0
    assert card.region_lengths_m == pytest.approx({"europe": 4.5, "north_america": 5.5})
    assert len(card.sha256) == 64


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("vehanchor.reference_length_m", "long"),
        ("vehanchor.reference_length_m", "nan"),
        ("vehanchor.min_score", "-1"),
        ("vehanchor.length_range_px", "9"),
        ("vehanchor.region_lengths_m", "[1]"),
        ("names", "{0: small"),
        ("names", "7"),
    ],
)
def test_unreadable_metadata_is_a_contract_error(tmp_path: Path, key: str, value: str) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata={key: value})
    with pytest.raises(ModelContractError):
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


def test_a_missing_execution_provider_is_named(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    with pytest.raises(ProviderUnavailableError, match=r"TensorrtExecutionProvider.*CPUExecutionProvider"):
        Detector(path, providers=["TensorrtExecutionProvider"])


@pytest.mark.parametrize("threads", [0, -2, 1.5])
def test_thread_counts_without_meaning_are_refused(tmp_path: Path, threads: Any) -> None:
    with pytest.raises(InvalidParameterError, match="threads"):
        Detector(write_detector(tmp_path / "m.onnx"), threads=threads)


def test_a_model_is_opened_once(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx")
    assert load_detector(path, threads=1) is load_detector(path, threads=1)
    assert load_detector(path, threads=1) is not load_detector(path, threads=2)
