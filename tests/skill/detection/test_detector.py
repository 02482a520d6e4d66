from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models import (
    BODIES,
    assert_same_boxes,
    blank_image,
    paint_vehicles,
    write_detector,
    write_other_model,
)
from vehanchor.detection.card import (
    LENGTH_RANGE_PX,
    MIN_SCORE,
    REFERENCE_LENGTH_M,
    ChipCard,
    DetectorCard,
    VerifierCard,
    read_card,
    read_detector_card,
)
from vehanchor.detection.contracts import EndToEnd, Raw, recognise_contract, vehicle_classes
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.errors import (
    InvalidParameterError,
    ModelContractError,
    ModelNotFoundError,
)
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Search

_DOTA = {
    0: "plane",
    1: "ship",
    2: "storage tank",
    3: "baseball diamond",
    4: "tennis court",
    5: "basketball court",
    6: "ground track field",
    7: "harbor",
    8: "bridge",
    9: "large vehicle",
    10: "small vehicle",
    11: "helicopter",
    12: "roundabout",
    13: "soccer ball field",
    14: "swimming pool",
}
_TWO = {0: "small_vehicle", 1: "large vehicle"}
_BOXES = np.array([[60.3, 50.7, 30, 12, 0.3], [150, 90, 28, 11, 1.9], [100.5, 200, 31, 12.5, 3.0]])


def _picture(
    boxes: NDArray[np.float64] = _BOXES, **kinds: Any
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    image = blank_image(256, 256)
    return image, paint_vehicles(image, boxes, **kinds)


def _searched(
    image: NDArray[np.uint8], detector: Detector, options: Search | None = None
) -> Detections:
    with open_raster(image) as raster:
        return ImageSearch(raster, detector, options).searched()


_CLASSES = [
    (layout, names)
    for layout in ("raw", "end2end")
    for names in ({0: "small-vehicle"}, _DOTA, _TWO)
]
# A raw export has a score for every class from 0 on.
_CLASSES.append(("end2end", {3: "car"}))


@pytest.mark.parametrize("fixed_size", [None, 256, 320])
@pytest.mark.parametrize(("layout", "names"), _CLASSES)
def test_every_layout_gives_the_painted_boxes(
    tmp_path: Path, layout: Any, fixed_size: int | None, names: dict[int, str]
) -> None:
    kind = next(index for index, name in names.items() if "small" in name or name == "car")
    image, painted = _picture(classes=[kind] * 3)
    path = write_detector(tmp_path / "m.onnx", layout=layout, names=names, fixed_size=fixed_size)
    detections = _searched(image, Detector(path))
    assert_same_boxes(detections.boxes, painted)
    np.testing.assert_allclose(detections.scores, 0.9, atol=1 / 255)


@pytest.mark.parametrize(
    ("changes", "within"),
    [({"swap_sides": True, "angle_offset": -6 * np.pi}, 1e-3), ({"dtype": "float16"}, 2e-2)],
    ids=["swapped sides, unbounded angles", "half precision"],
)
def test_other_forms_of_the_outputs_are_the_same_boxes(
    tmp_path: Path, changes: dict[str, Any], within: float
) -> None:
    image, painted = _picture()
    detector = Detector(write_detector(tmp_path / "m.onnx", **changes))
    assert_same_boxes(_searched(image, detector).boxes, painted, within)


@pytest.mark.parametrize(
    ("classes", "expected"),
    [
        (None, slice(0, 1)),
        (["small-vehicle", "Large_Vehicle"], slice(0, 2)),
        ([0], slice(2, 3)),
    ],
)
def test_the_caller_chooses_the_classes_of_vehicles(
    tmp_path: Path, classes: list[str | int] | None, expected: slice
) -> None:
    image, painted = _picture(classes=[10, 9, 0])
    path = write_detector(tmp_path / "m.onnx", names=_DOTA)
    detections = _searched(image, Detector(path, classes=classes))
    assert_same_boxes(detections.boxes, painted[expected])


@pytest.mark.parametrize("unknown", ["bus", 15])
def test_a_class_that_the_model_lacks_is_refused(tmp_path: Path, unknown: str | int) -> None:
    path = write_detector(tmp_path / "m.onnx", names=_DOTA)
    with pytest.raises(InvalidParameterError, match=str(unknown)):
        Detector(path, classes=[unknown])


# Without a choice, the paper's 0.1.
@pytest.mark.parametrize(("min_score", "n"), [(None, 2), (0.05, 3), (0.5, 1)])
def test_scores_below_the_threshold_are_dropped(
    tmp_path: Path, min_score: float | None, n: int
) -> None:
    image, _ = _picture(scores=[0.9, 0.3, 0.08])
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    detections = _searched(image, detector, Search(min_score=min_score))
    assert len(detections.boxes) == n


# --- Other files


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelNotFoundError, match="nowhere"):
        Detector(tmp_path / "nowhere.onnx")


def test_a_text_is_refused_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("not a model")
    with pytest.raises(ModelContractError, match=r"text\.onnx"):
        Detector(tmp_path / "text.onnx")


def test_half_a_file_is_refused_by_its_name(tmp_path: Path) -> None:
    whole = write_detector(tmp_path / "good.onnx").read_bytes()
    (tmp_path / "half.onnx").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelContractError, match=r"half\.onnx"):
        Detector(tmp_path / "half.onnx")


def test_another_model_is_refused_with_the_shape_of_its_output(tmp_path: Path) -> None:
    path = write_other_model(tmp_path / "classifier.onnx")
    with pytest.raises(ModelContractError, match=r"(?s)output.*\[.*3\].*Expected"):
        Detector(path)


def test_a_detector_without_vehicles_is_refused_with_its_classes(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "boats.onnx", names={0: "ship", 1: "harbor"})
    with pytest.raises(ModelContractError, match="ship, harbor"):
        Detector(path)


# --- Model cards


_PATH = Path("models/foreign.onnx")


def _card(**entries: str) -> DetectorCard:
    """Card of a foreign model; ``__`` in a name stands for a dot."""
    metadata = {key.replace("__", "."): text for key, text in entries.items()}
    return read_detector_card(_PATH, "0" * 64, metadata)


def _refusal(key: str, text: str) -> str:
    with pytest.raises(ModelContractError) as refused:
        read_detector_card(_PATH, "0" * 64, {key: text})
    return str(refused.value)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", "foreign"),
        ("reference_length_m", REFERENCE_LENGTH_M),
        ("min_score", MIN_SCORE),
        ("length_range_px", LENGTH_RANGE_PX),
        ("min_length_px", 0),
        ("stride_px", 32),
        ("search_scales", False),
        ("aggregation", "kde"),
        ("class_names", {}),
        ("licence", None),
        ("bodies", None),
        ("chips_sha256", None),
    ],
)
def test_a_foreign_model_gets_the_papers_values(field: str, value: Any) -> None:
    assert getattr(_card(), field) == value


def test_a_foreign_model_gets_the_papers_lengths() -> None:
    assert _card().reference_length_m == 5.045
    expected = {"europe": 4.5, "north_america": 5.5}
    assert _card().region_lengths_m == pytest.approx(expected)


@pytest.mark.parametrize(("length", "regions"), [("19", {"europe"}), ("2.1", {"north_america"})])
def test_a_region_whose_length_no_vehicle_has_is_left_out(length: str, regions: set[str]) -> None:
    assert set(_card(vehanchor__reference_length_m=length).region_lengths_m) == regions


@pytest.mark.parametrize(
    ("key", "text", "field", "value"),
    [
        ("vehanchor.name", "mine", "name", "mine"),
        ("vehanchor.reference_length_m", "4.6", "reference_length_m", 4.6),
        ("vehanchor.reference_length_sd_m", "0.3", "reference_length_sd_m", 0.3),
        ("vehanchor.length_range_px", "9,64", "length_range_px", (9.0, 64.0)),
        ("vehanchor.min_length_px", "13", "min_length_px", 13.0),
        ("vehanchor.min_score", "0.35", "min_score", 0.35),
        ("vehanchor.search_scales", "1", "search_scales", True),
        ("vehanchor.aggregation", "median", "aggregation", "median"),
        ("license", "Apache-2.0", "licence", "Apache-2.0"),
        ("stride", "16", "stride_px", 16),
        ("names", "{0: 'car', 1: 'ship'}", "class_names", {0: "car", 1: "ship"}),
        ("names", "['car', 'ship']", "class_names", {0: "car", 1: "ship"}),
        ("names", "", "class_names", {}),
    ],
)
def test_the_card_reads_the_metadata(key: str, text: str, field: str, value: Any) -> None:
    card = read_detector_card(_PATH, "0" * 64, {key: text})
    assert getattr(card, field) == value


def test_stated_regions_add_to_those_of_the_paper() -> None:
    card = _card(vehanchor__reference_length_m="4.6", vehanchor__region_lengths_m='{"asia": 4.3}')
    assert card.region_lengths_m["asia"] == 4.3
    assert card.region_lengths_m["europe"] == pytest.approx(4.6 * 4.5 / 5.045)


_INVALID_ENTRIES = {
    "vehanchor.reference_length_m": ("long", "", "nan", "inf", "0", "50"),
    "vehanchor.reference_length_sd_m": ("-0.1", "1e308"),
    "vehanchor.length_range_px": ("9", "9,64,80", "64,9", "0,64", "nan,64", "9,inf"),
    "vehanchor.min_length_px": ("-1",),
    "vehanchor.min_score": ("1.5",),
    "vehanchor.region_lengths_m": (
        "[1]",
        "{",
        '{"asia": 0}',
        '{"asia": NaN}',
        '{"a":' * 5_000,
        '{"a": 1' + "0" * 4000 + "}",
    ),
    "vehanchor.search_scales": ("2",),
    "vehanchor.aggregation": ("mode",),
    "stride": ("inf", "0", "1.5", "1e9"),
    "names": (
        "{0: small",
        "7",
        "'car'",
        "{-1: 'car'}",
        "{'a': 'car'}",
        "(" * 5_000,
        "{" * 200_000,
        "[" + "1," * 600_000 + "]",
    ),
}


@pytest.mark.parametrize(
    ("key", "text"), [(key, text) for key, texts in _INVALID_ENTRIES.items() for text in texts]
)
def test_an_entry_without_meaning_is_refused_by_its_name(key: str, text: str) -> None:
    message = _refusal(key, text)
    assert message.startswith(f"{_PATH}: metadata {key!r} is {text[:50]!r}"[:-1])
    assert "expected" in message


_AUXILIARY = {
    "vehanchor.detector": "m",
    "vehanchor.least_score": "0.15",
    "vehanchor.weights": "1,1,0",
}
_CHIPS = _AUXILIARY | {"vehanchor.bodies": json.dumps(BODIES)}
_VERIFIER = _AUXILIARY | {"vehanchor.min_score": "0.5"}


@pytest.mark.parametrize(
    ("kind", "key", "text"),
    [
        *((VerifierCard, "weights", text) for text in ("1,2", "one,two,three", "1,1,0,-1")),
        (VerifierCard, "min_score", "2"),
        *((ChipCard, "detector", text) for text in (None, "a" * (1 << 21))),
        *((ChipCard, "weights", text) for text in ("1,2", "-1,1,0")),
        (ChipCard, "bodies", None),
        (ChipCard, "bodies", json.dumps({**BODIES, "reference_length_m": 0.0})),
        (ChipCard, "bodies", json.dumps({"length_m": 4.0})),
    ],
)
def test_an_entry_of_an_auxiliary_model_is_refused_by_its_name(
    kind: Any, key: str, text: str | None
) -> None:
    metadata: dict[str, str] = _VERIFIER if kind is VerifierCard else _CHIPS
    read_card(kind, _PATH, sha256="1" * 64, metadata=metadata)
    changed = dict(metadata)
    changed.pop(f"vehanchor.{key}")
    if text is not None:
        changed[f"vehanchor.{key}"] = text
    with pytest.raises(ModelContractError, match=rf"foreign\.onnx.*vehanchor\.{key}.*expected"):
        read_card(kind, _PATH, sha256="1" * 64, metadata=changed)


# --- Classes


@pytest.mark.parametrize(
    ("names", "n_classes", "wanted", "indices"),
    [
        ({0: "plane", 1: "small-vehicle", 2: "car"}, 3, None, [1]),
        ({0: "bus", 1: "Car"}, 2, None, [1]),
        ({0: "roof", 1: "VEHICLE"}, None, None, [1]),
        ({3: "thing"}, None, None, [3]),
        ({}, 1, None, [0]),
        # Fifteen classes without names are in DOTA's order.
        ({}, 15, None, [10]),
        ({}, 15, ["large_vehicle", "ship"], [1, 9]),
        ({0: "a", 1: "b", 2: "b"}, 3, ["b", 0], [0, 1, 2]),
        ({}, 3, [2, 0, 2], [0, 2]),
        ({}, None, [7], [7]),
    ],
)
def test_vehicles_are_recognised_by_name_unless_the_caller_chooses(
    names: Any, n_classes: int | None, wanted: Any, indices: list[int]
) -> None:
    assert vehicle_classes(names, n_classes, wanted).tolist() == indices


# --- Layouts


@pytest.mark.parametrize(
    ("shape", "named", "kind"),
    [
        ((1, 6, 21504), {0}, Raw),
        ((1, 20, 21504), range(15), Raw),
        ((1, 20, 21504), (), Raw),
        # The names decide.
        ((1, 7, 7), {0, 1}, Raw),
        ((1, 300, 7), {0}, EndToEnd),
        ((1, 300, 7), {3}, EndToEnd),
        ((1, 300, 7), (), EndToEnd),
        ((1, 6, 7), (), EndToEnd),
    ],
)
def test_a_layout_is_recognised_by_its_shape_or_the_named_classes(
    shape: tuple[int, ...], named: range, kind: type
) -> None:
    assert type(recognise_contract([shape], named)) is kind


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ((1, 3), ()),
        # Upright boxes have no angle.
        ((1, 84, 8400), range(80)),
        ((1, 5, 8400), ()),
        # The second score is that of class 1, and class 2 has none.
        ((1, 7, 8400), {1, 2}),
        ((1, 300, 6), ()),
    ],
)
def test_other_layouts_are_refused_with_their_shape(shape: tuple[int, ...], named: range) -> None:
    with pytest.raises(ModelContractError) as refused:
        recognise_contract([shape], named)
    message = str(refused.value)
    assert str(list(shape)) in message
    assert f"{len(named)} class names" in message
    assert "[1, 4+classes+1, anchors] or [1, n, 7]" in message
