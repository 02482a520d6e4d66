"""What a model's file may say of itself, and what is refused by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from vehanchor.detection.appearance import FleetLengths
from vehanchor.detection.card import (
    LENGTH_RANGE_PX,
    MIN_SCORE,
    REFERENCE_LENGTH_M,
    DetectorCard,
    FleetCard,
    read_auxiliary_card,
    read_detector_card,
)
from vehanchor.errors import ModelContractError

_PATH = Path("models/foreign.onnx")
_LENGTHS = FleetLengths((-1.0, 1.0), (4.0, 5.0), 0.3, 2.0)
_FLEET = {"vehanchor.detector": "foreign", "vehanchor.fleet_lengths": json.dumps(_LENGTHS._asdict())}


def _card(**entries: str) -> DetectorCard:
    return read_detector_card(_PATH, "0" * 64, {key.replace("__", "."): text for key, text in entries.items()})


def _refusal(key: str, text: str) -> str:
    with pytest.raises(ModelContractError) as refused:
        read_detector_card(_PATH, "0" * 64, {key: text})
    return str(refused.value)


def test_a_foreign_model_gets_the_papers_values() -> None:
    card = _card()
    assert (card.name, card.reference_length_m, card.min_score) == ("foreign", REFERENCE_LENGTH_M, MIN_SCORE)
    assert card.reference_length_m == 5.045
    assert card.length_range_px == LENGTH_RANGE_PX
    assert card.min_length_px == 0
    assert card.region_lengths_m == pytest.approx({"europe": 4.5, "north_america": 5.5})
    assert (card.stride_px, card.search_scales, card.aggregation) == (32, False, "kde")
    assert (card.class_names, card.licence, card.fleet_lengths, card.fleet_sha256) == ({}, None, None, None)


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
        vehanchor__clear_score="0.77",
        vehanchor__aggregation="median",
        license="Apache-2.0",
        stride="16",
        names="{0: 'small vehicle', 1: 'ship'}",
    )
    assert (card.name, card.reference_length_m, card.reference_length_sd_m) == ("mine", 4.6, 0.3)
    assert (card.length_range_px, card.min_length_px, card.min_score) == ((9.0, 64.0), 13.0, 0.35)
    assert card.region_lengths_m["asia"] == 4.3
    assert card.region_lengths_m["europe"] == pytest.approx(4.6 * 4.5 / 5.045)
    assert (card.search_scales, card.clear_score, card.aggregation) == (True, 0.77, "median")
    assert (card.licence, card.stride_px) == ("Apache-2.0", 16)
    assert card.class_names == {0: "small vehicle", 1: "ship"}


@pytest.mark.parametrize(
    ("key", "text"),
    [
        *(("vehanchor.reference_length_m", text) for text in ("long", "", "nan", "inf", "0", "-4.4")),
        *(("vehanchor.reference_length_sd_m", text) for text in ("nan", "-0.1")),
        *(("vehanchor.length_range_px", text) for text in ("9", "9,64,80", "64,9", "9,9", "0,64", "nan,64", "9,inf")),
        *(("vehanchor.min_length_px", text) for text in ("-1", "nan")),
        *(("vehanchor.min_score", text) for text in ("-1", "1.5", "nan")),
        *(("vehanchor.clear_score", text) for text in ("-1", "1.5")),
        *(
            ("vehanchor.region_lengths_m", text)
            for text in ("[1]", "{", '{"asia": 0}', '{"asia": NaN}', '{"asia": "4"}')
        ),
        *(("vehanchor.search_scales", text) for text in ("yes", "2", "nan")),
        ("vehanchor.aggregation", "mode"),
        *(("stride", text) for text in ("inf", "nan", "0", "-32", "1.5", "1e9", "wide")),
        *(("vehanchor.region_lengths_m", text) for text in ('{"a":' * 5_000, '{"a": 1' + "0" * 4000 + "}")),
        *(("vehanchor.reference_length_m", text) for text in ("1e-300", "50")),
        *((f"vehanchor.{name}", "1e308") for name in ("reference_length_sd_m", "min_length_px")),
        ("vehanchor.length_range_px", "1e-9,1e300"),
        *(("names", text) for text in ("{0: small", "7", "'car'", "{-1: 'car'}", "{'a': 'car'}")),
    ],
)
def test_an_entry_without_meaning_is_refused_by_its_name(key: str, text: str) -> None:
    message = _refusal(key, text)
    assert f"metadata {key!r} is {text!r}"[:60] in message
    assert message.startswith(str(_PATH))


@pytest.mark.parametrize("text", ["(" * 5_000, "{" * 200_000, "[" + "1," * 600_000 + "]"])
def test_names_that_no_parser_bears_are_refused(text: str) -> None:
    assert "names" in _refusal("names", text)


def test_names_may_be_a_list_or_nothing() -> None:
    assert _card(names="['car', 'ship']").class_names == {0: "car", 1: "ship"}
    assert _card(names="").class_names == {}


def test_a_card_converts_nothing_and_cannot_be_changed() -> None:
    card = _card()
    values: dict[str, Any] = card.model_dump()
    for wrong in ({"min_score": "0.2"}, {"search_scales": 1}, {"length_range_px": [9.0, 64.0]}, {"sharpness": 1.0}):
        with pytest.raises(ValidationError):
            DetectorCard(**{**values, **wrong})
    with pytest.raises(ValidationError):
        card.min_score = 0.2


def test_the_card_of_a_fleet_network_names_its_detector_and_its_lengths() -> None:
    fleet = read_auxiliary_card(FleetCard, Path("m.fleet.onnx"), "1" * 64, _FLEET)
    assert fleet == FleetCard(sha256="1" * 64, detector="foreign", lengths=_LENGTHS)
    card = read_detector_card(_PATH, "0" * 64, {}, fleet)
    assert (card.fleet_lengths, card.fleet_sha256) == (_LENGTHS, "1" * 64)
    assert card.sha256 == "0" * 64


def test_a_fleet_network_made_for_another_detector_is_refused() -> None:
    fleet = read_auxiliary_card(FleetCard, Path("m.fleet.onnx"), "1" * 64, _FLEET)
    with pytest.raises(ModelContractError, match=r"'foreign'.*'mine'"):
        read_detector_card(_PATH, "0" * 64, {"vehanchor.name": "mine"}, fleet)


@pytest.mark.parametrize(
    "wrong",
    [
        {"log_lengths": [1.0, -1.0]},
        {"log_lengths": [0.0, float("nan")]},
        {"length_m": [4.0]},
        {"length_m": [0.0, 5.0]},
        {"sd_m": "wide"},
        {"sd_m": -0.1},
        {"neutral_vehicles": 0.0},
        {"colour": 1.0},
    ],
)
def test_fleet_lengths_without_meaning_are_refused_by_name(wrong: dict[str, Any]) -> None:
    metadata = _FLEET | {"vehanchor.fleet_lengths": json.dumps({**_LENGTHS._asdict(), **wrong})}
    with pytest.raises(ModelContractError, match=r"m\.fleet\.onnx: metadata 'vehanchor\.fleet_lengths'"):
        read_auxiliary_card(FleetCard, Path("m.fleet.onnx"), "1" * 64, metadata)


@pytest.mark.parametrize("key", sorted(_FLEET))
def test_a_fleet_network_that_does_not_say_what_it_is_for_is_refused(key: str) -> None:
    with pytest.raises(ModelContractError, match=f"no metadata '{key}'"):
        read_auxiliary_card(FleetCard, Path("m.fleet.onnx"), "1" * 64, {k: v for k, v in _FLEET.items() if k != key})
