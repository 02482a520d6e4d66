"""Options in their groups: which values are refused, presets, and vehicles by hand."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
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
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.options.rulers import MAX_BY_HAND, AddedVehicle, vehicle_numbers
from vehanchor.records import GsdEstimate

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
def test_an_invalid_value_is_refused_before_the_work(keywords: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError) as caught:
        vehanchor.estimate_gsd(_IMAGE, detector="nowhere.onnx", **keywords)
    name = next(iter(keywords))
    # The message about a known length names the line in other words.
    subject = name.removeprefix("frame_").rstrip("s").replace("known_length", "")
    assert subject in str(caught.value)


def test_numbers_of_numpy_become_numbers_of_python() -> None:
    keywords = {"min_score": np.float32(0.25), "tile_px": np.int64(512), "frame": (640.0, 480)}
    options = ScaleOptions.of(keywords)
    assert (type(options.search.min_score), options.search.min_score) == (float, 0.25)
    assert (type(options.search.tile_px), options.search.tile_px) == (int, 512)
    assert options.frame.size == (640, 480)


def test_a_calibration_is_read_from_its_file_at_once(tmp_path: Path) -> None:
    with pytest.raises(vehanchor.VehAnchorError, match="cannot read calibration"):
        Reference(calibration=str(tmp_path / "none.json"))  # type: ignore[arg-type]


# --- The preset of the paper

# Paper, equation 4 and section III-D.
LENGTH_M = 5.045
WEIGHTS = {"sample": 0.35, "concentration": 0.35, "quality": 0.20, "plausibility": 0.10}


class PaperCase(NamedTuple):
    """A record by the preset, with the lengths that the filter keeps, by the test's own rules."""

    record: GsdEstimate
    kept_px: NDArray[np.float64]
    min_length_px: float


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(resolve_model())


@pytest.fixture(
    scope="module", params=[case for case in CASES if "flight" not in str(case.values[0])]
)
def paper_case(request: pytest.FixtureRequest, detector: Detector) -> PaperCase:
    scene: Path = request.param
    record = vehanchor.estimate_gsd(scene, detector=detector, preset="paper")
    search = Search(min_score=0.1, search_scales=False, verify=False, effort="full")
    with open_raster(str(ROOT / scene)) as raster:
        detections = ImageSearch(raster, detector, search).searched()
    lengths = detections.boxes[:, 2]
    kept = lengths[lengths <= 1.5 * np.median(lengths)]
    return PaperCase(record, kept, detector.card.min_length_px)


def test_the_preset_counts_vehicles_after_the_filter(paper_case: PaperCase) -> None:
    assert paper_case.record.n_vehicles == len(paper_case.kept_px) >= 5


def test_the_preset_has_the_mode_of_the_papers_density(paper_case: PaperCase) -> None:
    kept = paper_case.kept_px
    points = np.linspace(kept.min(), kept.max(), 20_000)
    density = gaussian_kde(kept)(points)  # Its bandwidth is Scott's rule, like the paper's.
    mode = float(points[np.argmax(density)])
    assert paper_case.record.mode_length_px == pytest.approx(mode, rel=1e-3)


def test_the_preset_divides_the_papers_length_by_the_mode(paper_case: PaperCase) -> None:
    record = paper_case.record
    assert record.mode_length_px is not None
    assert record.gsd_m_per_px == pytest.approx(LENGTH_M / record.mode_length_px, rel=1e-12)


def test_the_preset_applies_the_papers_resolution_guard(paper_case: PaperCase) -> None:
    assert paper_case.record.details.resolution_guard == _is_guarded(paper_case)


def test_the_preset_has_the_papers_confidence(paper_case: PaperCase) -> None:
    record = paper_case.record
    assert record.details.confidence_terms is not None
    terms = record.details.confidence_terms.model_dump()
    total = sum(weight * terms[name] for name, weight in WEIGHTS.items())
    expected = min(total, 0.3) if _is_guarded(paper_case) else total
    assert record.confidence == pytest.approx(expected, rel=1e-12)
    assert record.details.composite_confidence == record.confidence


def test_the_preset_is_ok_from_a_confidence_of_one_half(paper_case: PaperCase) -> None:
    record = paper_case.record
    assert record.status == ("ok" if record.confidence >= 0.5 else "low_confidence")


def test_the_preset_uses_the_papers_options(paper_case: PaperCase) -> None:
    details = paper_case.record.details
    assert (details.reference_length_m, details.aggregation) == (LENGTH_M, "kde")
    assert details.tiles_searched == details.tiles_total
    assert [ruler.kind for ruler in paper_case.record.rulers] == ["vehicles"]


def _is_guarded(case: PaperCase) -> bool:
    assert case.record.mode_length_px is not None
    return case.record.mode_length_px < max(LENGTH_M / 0.3, case.min_length_px)


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
def test_a_preset_refuses_other_values_of_its_options(other: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError, match=f"the preset paper sets {next(iter(other))}"):
        ScaleOptions.of({"preset": "paper", **other})


@pytest.fixture
def with_preset() -> ScaleOptions:
    """The preset with values that do not contradict it: defaults, its own, and other options."""
    defaults = {"effort": "auto", "known_lengths": []}
    return ScaleOptions.of({"preset": "paper", "alpha": 1.5, "bgr": True, **defaults})


def test_a_preset_replaces_defaults(with_preset: ScaleOptions) -> None:
    assert with_preset.search.effort == "full"
    assert with_preset.rulers.rulers == ("vehicles",)


def test_a_preset_leaves_other_options_free(with_preset: ScaleOptions) -> None:
    assert with_preset.reading.bgr is True
    assert with_preset.with_keywords({"bgr": False}).method.preset == "paper"


def test_a_preset_refuses_later_changes_of_its_options(with_preset: ScaleOptions) -> None:
    with pytest.raises(InvalidParameterError, match="sets region"):
        with_preset.with_keywords({"region": "europe"})


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="preset is 'essay': use one of paper"):
        ScaleOptions.of({"preset": "essay"})


# --- Vehicles by hand


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"drop": "a"}, "drop is 'a': use numbers and ranges with commas"),
        ({"drop": [0]}, "drop is 0: use a whole number from 1"),
        ({"drop": [1.5]}, "drop is 1.5: use a whole number"),
        ({"add": [(1, 2, 3)]}, "add.0.y2 is .*missing"),
        ({"add": [(1, 2, 3, float("nan"))]}, "add.0.y2 is nan"),
        ({"add": 7}, "add is 7: give a list"),
        ({"drop": range(1, MAX_BY_HAND + 2)}, "give at most 1000"),
    ],
)
def test_invalid_vehicles_are_refused_with_a_remedy(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of(keywords)


def test_numbers_of_vehicles_are_read_from_ranges() -> None:
    assert ByHand(drop=vehicle_numbers("1-3, 7,7")).drop == (1, 2, 3, 7)


@pytest.mark.parametrize("text", ["a", "3-", "-3", "5-2", "1-99999", "1.5"])
def test_invalid_ranges_of_vehicles_are_refused(text: str) -> None:
    with pytest.raises(InvalidParameterError, match="drop"):
        vehicle_numbers(text)


def test_an_axis_is_read_from_four_numbers() -> None:
    axis = AddedVehicle(1.0, 2.0, x2=30.0, y2=2.5)
    assert ScaleOptions.of({"add": ["1, 2, 30 2.5"]}).by_hand.add == (axis,)


@pytest.mark.parametrize("text", ["1 2 3", "1 2 3 4 5", "a b c d"])
def test_an_axis_of_other_than_four_numbers_is_refused(text: str) -> None:
    with pytest.raises(InvalidParameterError, match=r"add\.0"):
        ScaleOptions.of({"add": [text]})


@pytest.mark.parametrize(
    ("axis", "message"),
    [
        ((0, 0, 4, 0), "add 1 is 4.0 px long"),
        ((90, 0, 101, 0), r"leaves the picture of 100 x 80 px"),
    ],
)
def test_an_axis_too_short_or_outside_is_refused(axis: tuple[float, ...], message: str) -> None:
    with pytest.raises(InvalidParameterError, match=message):
        ScaleOptions.of({"add": [axis]}).in_pixels(PixelGrid(100, 80))


def test_an_added_vehicle_has_the_callers_coordinates() -> None:
    options = ScaleOptions.of({"add": [(0.1, 0.5, 0.3, 0.5)], "coordinates": "fraction"})
    in_pixels = options.in_pixels(PixelGrid(1000, 400))
    assert astuple(in_pixels.by_hand.add[0]) == pytest.approx((100, 200, 300, 200))
    assert in_pixels.frame.coordinates == "pixels"
