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
    0: "plane", 1: "ship", 2: "storage "
        "tank", 3: "baseball diamond", 4: "tennis court", 5: "basketball court",
    6: "ground track "
        "field", 7: "harbor", 8: "bridge", 9: "large "
            "vehicle", 10: "small vehicle", 11: "helicopter",
    12: "roundabout", 13: "soccer ball field", 14: "swimming pool",
}  # fmt: skip
_TWO = {0: "small_vehicle", 1: "large vehicle"}
_BOXES = np.array([[60.3, 50.7, 30, 12, 0.3], [150, 90, 28, 11, 1.9], [100.5, 200, 31, 12.5, 3.0]])


def _picture(
    boxes: NDArray[np.float64] = _BOXES, **kinds: Any
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    image = blank_image(256, 256)
    return image, paint_vehicles(image, boxes, **kinds)


@pytest.mark.parametrize("fixed_size", [None, 256, 320])
@pytest.mark.parametrize(
    ("layout", "names"),
    [
        *(
            (layout, names)
            for layout in ("raw", "end2end")
            for names in ({0: "small-vehicle"}, _DOTA, _TWO)
        ),
        ("end2end", {3: "car"}),  # a raw export has a score for every class from 0 on
    ],
)
def test_every_layout_gives_the_painted_boxes(
    tmp_path: Path, layout: Any, fixed_size: int | None, names: dict[int, str]
) -> None:
    kind = next(i for i, name in names.items() if "small" in name or name == "car")
    image, painted = _picture(classes=[kind] * 3)
    detector = Detector(
        write_detector(tmp_path / "m.onnx", layout=layout, names=names, fixed_size=fixed_size)
    )
    with open_raster(image) as raster:
        found = ImageSearch(raster, detector).searched()
    assert_same_boxes(found.boxes, painted)
    np.testing.assert_allclose(found.scores, 0.9, atol=1 / 255)


@pytest.mark.parametrize(
    ("changes", "within"),
    [({"swap_sides": True, "angle_offset": -6 * np.pi}, 1e-3), ({"dtype": "float16"}, 2e-2)],
)
def test_swapped_sides_unbounded_angles_and_half_precision_are_the_same_boxes(
    tmp_path: Path, changes: dict[str, Any], within: float
) -> None:
    image, painted = _picture()
    with open_raster(image) as raster:
        assert_same_boxes(
            ImageSearch(raster, Detector(write_detector(tmp_path / "m.onnx", **changes)))
            .searched()
            .boxes,
            painted,
            within,
        )


def test_other_classes_are_not_vehicles_unless_asked_for(tmp_path: Path) -> None:
    image, painted = _picture(classes=[10, 9, 0])
    path = write_detector(tmp_path / "m.onnx", names=_DOTA)

    def found(classes: list[str | int] | None) -> NDArray[np.float64]:
        with open_raster(image) as raster:
            return ImageSearch(raster, Detector(path, classes=classes)).searched().boxes

    assert_same_boxes(found(None), painted[:1])
    assert_same_boxes(found(["small-vehicle", "Large_Vehicle"]), painted[:2])
    assert_same_boxes(found([0]), painted[2:])
    for unknown in ("bus", 15):
        with pytest.raises(InvalidParameterError, match=str(unknown)):
            found([unknown])


def test_scores_below_the_threshold_are_dropped(tmp_path: Path) -> None:
    image, _ = _picture(scores=[0.9, 0.3, 0.08])
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(image) as raster:
        assert len(ImageSearch(raster, detector).searched().boxes) == 2  # the paper's 0.1
        assert len(ImageSearch(raster, detector, Search(min_score=0.05)).searched().boxes) == 3
        assert len(ImageSearch(raster, detector, Search(min_score=0.5)).searched().boxes) == 1


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


_PATH = Path("models/foreign.onnx")


def _card(**entries: str) -> DetectorCard:
    return read_detector_card(
        _PATH, "0" * 64, {key.replace("__", "."): text for key, text in entries.items()}
    )


def _refusal(key: str, text: str) -> str:
    with pytest.raises(ModelContractError) as refused:
        read_detector_card(_PATH, "0" * 64, {key: text})
    return str(refused.value)


def test_a_foreign_model_gets_the_papers_values() -> None:
    card = _card()
    assert (card.name, card.reference_length_m, card.min_score) == (
        "foreign",
        REFERENCE_LENGTH_M,
        MIN_SCORE,
    )
    assert card.reference_length_m == 5.045
    assert card.length_range_px == LENGTH_RANGE_PX
    assert card.min_length_px == 0
    assert card.region_lengths_m == pytest.approx({"europe": 4.5, "north_america": 5.5})
    assert (card.stride_px, card.search_scales, card.aggregation) == (32, False, "kde")
    assert (card.class_names, card.licence, card.bodies, card.chips_sha256) == (
        {},
        None,
        None,
        None,
    )


@pytest.mark.parametrize(("length", "regions"), [("19", {"europe"}), ("2.1", {"north_america"})])
def test_regions_that_follow_from_a_models_length_are_left_out_where_no_vehicle_is_so_long(
    length: str, regions: set[str]
) -> None:
    assert set(_card(vehanchor__reference_length_m=length).region_lengths_m) == regions


def test_the_card_reads_our_metadata() -> None:
    card = _card(
        vehanchor__name="mine",
        vehanchor__reference_length_m="4.6",
        vehanchor__reference_length_sd_m="0.3",
        vehanchor__length_range_px="9,64",
        vehanchor__min_length_px="13",
        vehanchor__min_score="0.35",
        vehanchor__region_lengths_m='{"asia": 4.3}',
        vehanchor__search_scales="1",
        vehanchor__aggregation="median",
        license="Apache-2.0",
        stride="16",
        names="{0: 'small vehicle', 1: 'ship'}",
    )
    assert (card.name, card.reference_length_m, card.reference_length_sd_m) == ("mine", 4.6, 0.3)
    assert (card.length_range_px, card.min_length_px, card.min_score) == ((9.0, 64.0), 13.0, 0.35)
    assert card.region_lengths_m["asia"] == 4.3
    assert card.region_lengths_m["europe"] == pytest.approx(4.6 * 4.5 / 5.045)
    assert (card.search_scales, card.aggregation) == (True, "median")
    assert (card.licence, card.stride_px) == ("Apache-2.0", 16)
    assert card.class_names == {0: "small vehicle", 1: "ship"}


@pytest.mark.parametrize(
    ("key", "text"),
    [
        *(("vehanchor.reference_length_m", text) for text in ("long", "", "nan", "inf", "0", "50")),
        *(("vehanchor.reference_length_sd_m", text) for text in ("-0.1", "1e308")),
        *(
            ("vehanchor.length_range_px", text)
            for text in ("9", "9,64,80", "64,9", "0,64", "nan,64", "9,inf")
        ),
        ("vehanchor.min_length_px", "-1"),
        ("vehanchor.min_score", "1.5"),
        *(
            ("vehanchor.region_lengths_m", text)
            for text in ("[1]", "{", '{"asia": 0}', '{"asia": NaN}')
        ),
        *(
            ("vehanchor.region_lengths_m", text)
            for text in ('{"a":' * 5_000, '{"a": 1' + "0" * 4000 + "}")
        ),
        ("vehanchor.search_scales", "2"),
        ("vehanchor.aggregation", "mode"),
        *(("stride", text) for text in ("inf", "0", "1.5", "1e9")),
        *(("names", text) for text in ("{0: small", "7", "'car'", "{-1: 'car'}", "{'a': 'car'}")),
        *(("names", text) for text in ("(" * 5_000, "{" * 200_000, "[" + "1," * 600_000 + "]")),
    ],
)
def test_an_entry_without_meaning_is_refused_by_its_name(key: str, text: str) -> None:
    message = _refusal(key, text)
    assert message.startswith(f"{_PATH}: metadata {key!r} is {text[:50]!r}"[:-1])
    assert "expected" in message


def test_names_may_be_a_list_or_nothing() -> None:
    assert _card(names="['car', 'ship']").class_names == {0: "car", 1: "ship"}
    assert _card(names="").class_names == {}


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
    metadata = _VERIFIER if kind is VerifierCard else _CHIPS
    read_card(kind, _PATH, sha256="1" * 64, metadata=metadata)
    changed = {**metadata, f"vehanchor.{key}": text}
    with pytest.raises(ModelContractError, match=rf"foreign\.onnx.*vehanchor\.{key}.*expected"):
        read_card(
            kind,
            _PATH,
            sha256="1" * 64,
            metadata={name: each for name, each in changed.items() if each is not None},
        )


@pytest.mark.parametrize(
    ("names", "n_classes", "wanted", "found"),
    [
        ({0: "plane", 1: "small-vehicle", 2: "car"}, 3, None, [1]),
        ({0: "bus", 1: "Car"}, 2, None, [1]),
        ({0: "roof", 1: "VEHICLE"}, None, None, [1]),
        ({3: "thing"}, None, None, [3]),
        ({}, 1, None, [0]),
        ({}, 15, None, [10]),  # DOTA's order
        ({}, 15, ["large_vehicle", "ship"], [1, 9]),
        ({0: "a", 1: "b", 2: "b"}, 3, ["b", 0], [0, 1, 2]),
        ({}, 3, [2, 0, 2], [0, 2]),
        ({}, None, [7], [7]),
    ],
)
def test_vehicles_are_told_by_name_or_as_asked(
    names: Any, n_classes: int | None, wanted: Any, found: list[int]
) -> None:
    assert vehicle_classes(names, n_classes, wanted).tolist() == found


@pytest.mark.parametrize(
    ("shape", "named", "kind"),
    [
        ((1, 6, 21504), {0}, Raw),
        ((1, 20, 21504), range(15), Raw),
        ((1, 20, 21504), (), Raw),
        ((1, 7, 7), {0, 1}, Raw),  # the names decide
        ((1, 300, 7), {0}, EndToEnd),
        ((1, 300, 7), {3}, EndToEnd),
        ((1, 300, 7), (), EndToEnd),
        ((1, 6, 7), (), EndToEnd),
    ],
)
def test_a_layout_is_told_by_its_shape_and_the_named_classes(
    shape: tuple[int, ...], named: range, kind: type
) -> None:
    assert type(recognise_contract([shape], named)) is kind


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ((1, 3), ()),
        ((1, 84, 8400), range(80)),  # upright boxes: no angle
        ((1, 5, 8400), ()),
        ((1, 7, 8400), {1, 2}),  # the second score is of class 1, there is none of class 2
        ((1, 300, 6), ()),
    ],
)
def test_other_layouts_are_refused_with_what_was_found_and_what_is_expected(
    shape: tuple[int, ...], named: range
) -> None:
    with pytest.raises(ModelContractError) as refused:
        recognise_contract([shape], named)
    message = str(refused.value)
    assert str(list(shape)) in message
    assert f"{len(named)} class names" in message
    assert "[1, 4+classes+1, anchors] or [1, n, 7]" in message
