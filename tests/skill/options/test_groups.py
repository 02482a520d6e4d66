from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import gaussian_kde

import vehanchor
from tests.conftest import ROOT
from tests.records import CASES
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ByHand, Reference, ScaleOptions, Search
from vehanchor.options.rulers import MOST_BY_HAND, AddedVehicle, vehicle_numbers

_IMAGE = np.zeros((64, 64, 3), np.uint8)


@pytest.mark.parametrize(
    "keywords",
    [
        {"min_score": "much"},
        {"min_score": float("nan")},
        {"stride_px": 300.7},
        {"search_scales": 1},
        {"aggregation": "modal"},
        {"reference_length_m": True},
        {"reference_length_m": "4.5 kg"},
        {"reference_length_m": 4.5, "region": "europe"},
        {"frame": (320.5, 240)},
        {"coordinates": "percent"},
        {"bands": (1, 2)},
        {"bands": (0, 1, 2)},
        {"scale": 3},
        {"rulers": ("vehicles", "yardstick")},
        {"known_lengths": [(0, 0, 1, 0, 5)]},
        {"known_lengths": [(0, 0, 30, 0, 0)]},
        {"known_lengths": [(0, 0, 30, 0, float("inf"))]},
        {"known_lengths": [(0, 0, 30, 0)]},
        {"focal_35mm": 24, "metadata": False},
        {"region": ["europe"]},
        {"rulers": [["vehicles"]]},
        {"limits": {}},
        {"calibration": 5},
    ],
)
def test_a_value_without_meaning_is_refused_before_any_work(keywords: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError) as refused:
        vehanchor.estimate_gsd(_IMAGE, detector="nowhere.onnx", **keywords)
    assert next(iter(keywords)).removeprefix("frame_").rstrip("s").replace(
        "known_length", ""
    ) in str(refused.value)


def test_numbers_of_any_library_come_out_as_pythons() -> None:
    options = ScaleOptions.of(
        {"min_score": np.float32(0.25), "tile_px": np.int64(512), "frame": (640.0, 480)}
    )
    assert (type(options.search.min_score), options.search.min_score) == (float, 0.25)
    assert (type(options.search.tile_px), options.search.tile_px) == (int, 512)
    assert options.frame.size == (640, 480)


def test_a_calibration_is_read_from_its_file_at_once(tmp_path: Path) -> None:
    with pytest.raises(vehanchor.VehAnchorError, match="cannot read calibration"):
        Reference(calibration=str(tmp_path / "none.json"))  # type: ignore[arg-type]


LENGTH_M = 5.045
WEIGHTS = {"sample": 0.35, "concentration": 0.35, "quality": 0.20, "plausibility": 0.10}


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(resolve_model())


@pytest.mark.parametrize("scene", [case for case in CASES if "flight" not in str(case.values[0])])
def test_the_preset_gives_the_papers_numbers(scene: Path, detector: Detector) -> None:
    record = vehanchor.estimate_gsd(scene, detector=detector, preset="paper")
    with open_raster(str(ROOT / scene)) as raster:
        found = ImageSearch(
            raster,
            detector,
            Search(min_score=0.1, search_scales=False, verify=False, effort="full"),
        ).searched()
    lengths = found.boxes[:, 2]
    kept = lengths[lengths <= 1.5 * np.median(lengths)]
    assert record.n_vehicles == len(kept) >= 5
    points = np.linspace(kept.min(), kept.max(), 20_000)
    mode = float(points[np.argmax(gaussian_kde(kept)(points))])  # Scott's rule
    assert record.mode_length_px == pytest.approx(mode, rel=1e-3)
    assert record.mode_length_px is not None
    assert record.gsd_m_per_px == pytest.approx(LENGTH_M / record.mode_length_px, rel=1e-12)
    assert record.details.confidence_terms is not None
    terms = record.details.confidence_terms.model_dump()
    total = sum(weight * terms[name] for name, weight in WEIGHTS.items())
    guarded = record.mode_length_px < max(LENGTH_M / 0.3, detector.card.min_length_px)
    assert record.details.resolution_guard == guarded
    assert record.confidence == pytest.approx(min(total, 0.3) if guarded else total, rel=1e-12)
    assert record.details.composite_confidence == record.confidence
    assert record.status == ("ok" if record.confidence >= 0.5 else "low_confidence")
    assert (record.details.reference_length_m, record.details.aggregation) == (LENGTH_M, "kde")
    assert record.details.tiles_searched == record.details.tiles_total
    assert [ruler.kind for ruler in record.rulers] == ["vehicles"]


@pytest.mark.parametrize(
    "other",
    [
        {"alpha": 2.0},
        {"alpha": None},
        {"region": "europe"},
        {"rulers": ("courts",)},
        {"height_m": 50.0},
        {"drop": (1,)},
    ],
)
def test_the_preset_takes_no_other_value_of_its_options(other: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError, match=f"the preset paper sets {next(iter(other))}"):
        ScaleOptions.of({"preset": "paper", **other})


def test_options_beside_the_preset_are_free_and_defaults_are_no_conflict() -> None:
    chosen = ScaleOptions.of(
        {"preset": "paper", "alpha": 1.5, "effort": "auto", "known_lengths": [], "bgr": True}
    )
    assert (chosen.search.effort, chosen.reading.bgr, chosen.rulers.rulers) == (
        "full",
        True,
        ("vehicles",),
    )
    assert chosen.with_keywords({"bgr": False}).method.preset == "paper"
    with pytest.raises(InvalidParameterError, match="sets region"):
        chosen.with_keywords({"region": "europe"})


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="preset is 'essay': use one of paper"):
        ScaleOptions.of({"preset": "essay"})


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"drop": "a"}, "drop is 'a': use numbers and ranges with commas"),
        ({"drop": [0]}, "drop is 0: use a whole number from 1"),
        ({"drop": [1.5]}, "drop is 1.5: use a whole number"),
        ({"add": [(1, 2, 3)]}, "add.0.y2 is .*missing"),
        ({"add": [(1, 2, 3, float("nan"))]}, "add.0.y2 is nan"),
        ({"add": 7}, "add is 7: give a list"),
        ({"drop": range(1, MOST_BY_HAND + 2)}, "give at most 1000"),
    ],
)
def test_wrong_vehicles_are_refused_with_what_to_give(told: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of(told)


def test_numbers_are_read_as_lists_and_ranges() -> None:
    assert ByHand(drop=vehicle_numbers("1-3, 7,7")).drop == (1, 2, 3, 7)
    for wrong in ("a", "3-", "-3", "5-2", "1-99999", "1.5"):
        with pytest.raises(InvalidParameterError, match="drop"):
            vehicle_numbers(wrong)


def test_an_axis_is_read_from_four_numbers() -> None:
    assert ScaleOptions.of({"add": ["1, 2, 30 2.5"]}).by_hand.add == (
        AddedVehicle(1.0, 2.0, 30.0, 2.5),
    )
    for wrong in ("1 2 3", "1 2 3 4 5", "a b c d"):
        with pytest.raises(InvalidParameterError, match=r"add\.0"):
            ScaleOptions.of({"add": [wrong]})


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        ((0, 0, 4, 0), "add 1 is 4.0 px long"),
        ((90, 0, 101, 0), r"leaves the picture of 100 x 80 px"),
    ],
)
def test_an_added_vehicle_is_inside_and_long_enough(axis: tuple[float, ...], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of({"add": [axis]}).in_pixels(100, 80)


def test_an_added_vehicle_has_the_callers_coordinates() -> None:
    told = ScaleOptions.of({"add": [(0.1, 0.5, 0.3, 0.5)], "coordinates": "fraction"}).in_pixels(
        1000, 400
    )
    assert astuple(told.by_hand.add[0]) == pytest.approx((100, 200, 300, 200))
    assert told.frame.coordinates == "pixels"
