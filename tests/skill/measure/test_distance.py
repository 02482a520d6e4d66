from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from tests.models import blank_image, pool_among_cars
from tests.sam_models import write_sam
from vehanchor.cli import app as cli
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    InvalidParameterError,
    KnownLengthError,
    PromptError,
    ScaleMismatchError,
    TooObliqueError,
)
from vehanchor.options import ScaleOptions
from vehanchor.pictures.scale import write_picture
from vehanchor.records import DistanceMeasurement, KnownScale
from vehanchor.segmentation.segmenter import Segmenter

BOX = (410.7, 273.9, 477.3, 382.1)
# Quicker: no network except the detector looks at the image.
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}
# A distance between two points at a given scale: one step of error for each point.
_POINTING_LOG_SD = math.sqrt(2)


def _measure(path: Any, **options: Any) -> DistanceMeasurement:
    """Measure a path in an image of 800 x 600 px at 0.1 metres per pixel."""
    return vehanchor.measure_distance(pool_among_cars(0), path, gsd_m_per_px=0.1, **options)


@pytest.fixture(scope="module")
def estimate(detector: Detector) -> vehanchor.GsdEstimate:
    return vehanchor.estimate_gsd(pool_among_cars(), detector=detector, **ALONE)


@pytest.fixture(scope="module")
def around_corner(detector: Detector) -> DistanceMeasurement:
    """Record of a path of 700 px, at the scale of the vehicles."""
    path = [(100, 500), (400, 500), (400, 100)]
    return vehanchor.measure_distance(pool_among_cars(), path, detector=detector, **ALONE)


def test_a_distance_is_the_paths_pixels_times_the_scale(
    around_corner: DistanceMeasurement, estimate: vehanchor.GsdEstimate
) -> None:
    assert estimate.gsd_m_per_px is not None
    assert around_corner.length_px == 700
    assert around_corner.distance_m == pytest.approx(700 * estimate.gsd_m_per_px)


def test_the_interval_of_a_distance_contains_that_of_its_scale(
    around_corner: DistanceMeasurement, estimate: vehanchor.GsdEstimate
) -> None:
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert around_corner.distance_ci95_low_m is not None
    assert around_corner.distance_ci95_low_m < 700 * estimate.gsd_ci95_low_m_per_px * 1.02


def test_a_distance_has_the_estimate_of_its_image(
    around_corner: DistanceMeasurement, estimate: vehanchor.GsdEstimate
) -> None:
    assert (around_corner.estimate, around_corner.scale) == (estimate, estimate.scale)
    assert (around_corner.status, around_corner.scale_source) == ("ok", "estimated")
    assert around_corner.scale_confidence == estimate.confidence
    assert around_corner.n_vehicles == 30


@pytest.fixture(scope="module")
def across() -> DistanceMeasurement:
    """Record of a straight line of 100 px."""
    return _measure([(100, 100), (200, 100)])


def test_at_a_given_scale_only_the_pointing_is_uncertain(across: DistanceMeasurement) -> None:
    reach = 1.96 * _POINTING_LOG_SD / 100
    assert across.distance_m == pytest.approx(10)
    assert across.distance_ci95_low_m == pytest.approx(10 * math.exp(-reach), rel=1e-4)


def test_a_given_scale_has_no_evidence(across: DistanceMeasurement) -> None:
    assert (across.status, across.scale_source) == ("ok", "given")
    assert across.scale_confidence is None
    assert across.n_vehicles is None


def test_a_stop_on_a_straight_line_adds_no_doubt(across: DistanceMeasurement) -> None:
    with_stop = _measure([(100, 100), (150, 100), (200, 100)])
    assert with_stop.distance_ci95_high_m == pytest.approx(across.distance_ci95_high_m)


@pytest.mark.parametrize(
    ("path", "options"),
    [
        ([(100, 150), (500, 450)], {}),
        ([(50, 75), (250, 225)], {"frame": (400, 300)}),
        ([(0.125, 0.25), (0.625, 0.75)], {"coordinates": "fraction"}),
        ([(125, 250), (625, 750)], {"coordinates": "per_mille"}),
    ],
)
def test_a_path_means_the_same_in_all_coordinates(path: Any, options: Any) -> None:
    record = _measure(path, **options)
    assert record.distance_m == pytest.approx(50)
    assert [(point.x_px, point.y_px) for point in record.path] == [(100, 150), (500, 450)]


def test_a_coarser_copy_has_a_larger_error_of_pointing() -> None:
    fine = _measure([(100, 150), (500, 450)])
    coarse = _measure([(25.0, 37.5), (125.0, 112.5)], frame=(200, 150))
    assert fine.distance_ci95_high_m is not None
    assert coarse.distance_ci95_high_m is not None
    # A pixel of the copy is four pixels of the image.
    fine_reach = math.log(fine.distance_ci95_high_m / 50)
    coarse_reach = math.log(coarse.distance_ci95_high_m / 50)
    assert coarse_reach == pytest.approx(4 * fine_reach)


def test_without_vehicles_there_are_pixels_but_no_metres(detector: Detector) -> None:
    record = vehanchor.measure_distance(
        pool_among_cars(0), [(100, 100), (200, 100)], detector=detector
    )
    assert (record.status, record.scale_confidence) == ("no_scale", 0)
    assert record.length_px == 100
    assert record.distance_m is None
    assert record.distance_ci95_low_m is None


@pytest.mark.parametrize(
    ("path", "options", "words"),
    [
        (5, {}, "path is 5: give a line, or points"),
        ("1 2", {}, "path is '1 2': give a line, or points"),
        ([(1, 1)], {}, "the path has 1 point: give two"),
        ([], {}, "0 points"),
        ([(1, 1), (1, 2, 3)], {}, "use x, y"),
        ([(1, 1), (float("nan"), 2)], {}, "finite"),
        ([(5, 5), (5.5, 5)], {}, "0.5 px of the full image long: at least 2 px are needed$"),
        ([(0.5, 0.5), (0.5, 0.5)], {}, "0 px of the full image long: at least 2 px are needed$"),
        (
            [(1, 1), (801.5, 5)],
            {},
            r"read it in the picture of 1024 x 768 px from view_image, .* to \"per_mille\"$",
        ),
        ([(1, 1), (1201.5, 5)], {}, "is not inside the 800 x 600 px image$"),
        (
            [(0.1, 0.2), (0.9, 0.9)],
            {},
            'it would be valid: for fractions, set coordinates to "frac',
        ),
        ([(1, 1), (3000, 5)], {}, "is not inside the 800 x 600 px image$"),
        ([(1, 1), (5, -9)], {}, "is not inside the 800 x 600 px image$"),
        ([(0.1, 0.2), (1.2, 0.3)], {"coordinates": "fraction"}, "coordinates go from 0 to 1$"),
        ([(1, 2), (1200, 3)], {"coordinates": "per_mille"}, "coordinates go from 0 to 1000$"),
    ],
)
def test_an_invalid_path_is_refused_with_a_suggestion(path: Any, options: Any, words: str) -> None:
    with pytest.raises(PromptError, match=words):
        _measure(path, **options)


@pytest.mark.parametrize(
    ("box", "words"),
    [
        ((700, 500, 950, 700), "picture of 1024 x 768"),
        ((0.1, 0.1, 0.4, 0.6), "as fractions"),
    ],
)
def test_an_invalid_box_is_refused_with_a_suggestion(
    segmenter: Segmenter, box: Any, words: str
) -> None:
    with pytest.raises(PromptError, match=words):
        vehanchor.measure_area(pool_among_cars(0), box=box, gsd_m_per_px=0.1, segmenter=segmenter)


def test_a_box_in_fractions_is_the_box_in_pixels(segmenter: Segmenter) -> None:
    options: dict[str, Any] = {"gsd_m_per_px": 0.1, "segmenter": segmenter}
    in_pixels = vehanchor.measure_area(pool_among_cars(0), box=BOX, **options)
    x1, y1, x2, y2 = BOX
    fractions = (x1 / 800, y1 / 600, x2 / 800, y2 / 600)
    in_fractions = vehanchor.measure_area(
        pool_among_cars(0), box=fractions, coordinates="fraction", **options
    )
    assert in_fractions == in_pixels


def test_a_known_length_in_fractions_is_the_one_in_pixels(detector: Detector) -> None:
    in_pixels = vehanchor.estimate_gsd(
        pool_among_cars(), detector=detector, known_lengths=[(80, 60, 480, 360, 80)]
    )
    fractions = [(0.1, 0.1, 0.6, 0.6, 80)]
    in_fractions = vehanchor.estimate_gsd(
        pool_among_cars(), detector=detector, known_lengths=fractions, coordinates="fraction"
    )
    assert in_fractions == in_pixels
    assert "known_length" in [ruler.kind for ruler in in_fractions.rulers]


def test_a_known_length_that_is_short_in_pixels_is_refused(detector: Detector) -> None:
    short = [(0.1, 0.1, 0.101, 0.1, 8)]
    with pytest.raises(KnownLengthError, match="px long"):
        vehanchor.estimate_gsd(
            pool_among_cars(), detector=detector, known_lengths=short, coordinates="fraction"
        )


@pytest.fixture(scope="module")
def skewed(estimate: vehanchor.GsdEstimate) -> KnownScale:
    """A scale of 0.136 metres per pixel, whose interval is longer above than below."""
    assert estimate.scale is not None
    interval = {
        "gsd_m_per_px": 0.136,
        "gsd_ci95_low_m_per_px": 0.121,
        "gsd_ci95_high_m_per_px": 0.185,
    }
    return estimate.scale.model_copy(update=interval)


def test_a_distance_has_the_skewed_interval_of_its_scale(skewed: KnownScale) -> None:
    line = vehanchor.measure_distance(pool_among_cars(), [(20, 580), (780, 580)], scale=skewed)
    pointing = _POINTING_LOG_SD / 760 * 1.96
    below = math.hypot(math.log(136 / 121), pointing)
    above = math.hypot(math.log(185 / 136), pointing)
    distance_m = 760 * 0.136
    assert line.distance_ci95_low_m == pytest.approx(distance_m * math.exp(-below), rel=1e-4)
    assert line.distance_ci95_high_m == pytest.approx(distance_m * math.exp(above), rel=1e-4)


def test_an_area_has_the_skewed_interval_of_its_scale(skewed: KnownScale, tmp_path: Path) -> None:
    exactness = {"vehanchor.mask_area_log_sd": "0", "vehanchor.mask_width_log_sd": "0"}
    exact = write_sam(tmp_path, metadata=exactness)
    roof = vehanchor.measure_area(pool_among_cars(), box=BOX, segmenter=exact, scale=skewed)
    assert roof.area_m2 is not None
    assert roof.area_ci95_low_m2 == pytest.approx(roof.area_m2 * (121 / 136) ** 2)
    assert roof.area_ci95_high_m2 == pytest.approx(roof.area_m2 * (185 / 136) ** 2)
    assert roof.inscribed_diameter_m is not None
    largest_m = roof.inscribed_diameter_m * 185 / 136
    assert roof.inscribed_diameter_ci95_high_m == pytest.approx(largest_m)


NOWHERE = "there is none.onnx"


def _values(record: Any, *names: str) -> list[Any]:
    return [getattr(record, name) for name in names]


def test_a_distance_at_a_scale_given_back_is_the_same(
    estimate: vehanchor.GsdEstimate, detector: Detector
) -> None:
    path = [(100.0, 500.0), (400.0, 500.0)]
    searched = vehanchor.measure_distance(pool_among_cars(), path, detector=detector, **ALONE)
    reused = vehanchor.measure_distance(
        pool_among_cars(), path, scale=estimate.scale, detector=NOWHERE
    )
    same = (
        "distance_m",
        "distance_ci95_low_m",
        "distance_ci95_high_m",
        "scale_confidence",
        "status",
        "gsd_m_per_px",
    )
    assert _values(reused, *same) == _values(searched, *same)


def test_a_measurement_names_the_scale_given_back(estimate: vehanchor.GsdEstimate) -> None:
    assert isinstance(estimate.scale, KnownScale)
    path = [(100.0, 500.0), (400.0, 500.0)]
    reused = vehanchor.measure_distance(
        pool_among_cars(), path, scale=estimate.scale, detector=NOWHERE
    )
    assert (reused.scale_source, reused.estimate, reused.n_vehicles) == ("reused", None, None)
    assert reused.scale == estimate.scale


def test_an_area_at_a_scale_given_back_is_the_same(
    estimate: vehanchor.GsdEstimate, detector: Detector, segmenter: Segmenter
) -> None:
    searched = vehanchor.measure_area(
        pool_among_cars(), box=BOX, segmenter=segmenter, detector=detector, **ALONE
    )
    reused = vehanchor.measure_area(
        pool_among_cars(), box=BOX, segmenter=segmenter, scale=estimate, detector=NOWHERE
    )
    same = (
        "area_m2",
        "area_ci95_low_m2",
        "inscribed_diameter_ci95_high_m",
        "scale_confidence",
        "status",
        "warnings",
    )
    assert _values(reused, *same) == _values(searched, *same)
    assert reused.scale_source == "reused"


def test_a_scale_is_refused_for_another_image(estimate: vehanchor.GsdEstimate) -> None:
    other = pool_among_cars()
    # A single pixel.
    other[599, 799] += 1
    with pytest.raises(ScaleMismatchError, match="measured on another image") as refused:
        vehanchor.measure_distance(other, [(1, 1), (99, 99)], scale=estimate)
    assert refused.value.code == "scale_mismatch"


SIZES = ("gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")
_NOT_AN_ESTIMATE = "scale is not what an estimate gave"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gsd_m_per_px": -1}, _NOT_AN_ESTIMATE),
        ({"confidence": 2}, _NOT_AN_ESTIMATE),
        ({"image_id": None}, _NOT_AN_ESTIMATE),
        ({"more": 1}, _NOT_AN_ESTIMATE),
        ({"gsd_ci95_high_m_per_px": 0.001}, _NOT_AN_ESTIMATE),
        # Too large for its square.
        (dict.fromkeys(SIZES, 1e308), "no image has"),
    ],
)
def test_a_changed_scale_without_meaning_is_refused(
    estimate: vehanchor.GsdEstimate, change: dict[str, Any], words: str
) -> None:
    assert estimate.scale is not None
    changed = {**estimate.scale.model_dump(), **change}
    with pytest.raises(InvalidParameterError, match=words):
        vehanchor.measure_distance(pool_among_cars(), [(1, 1), (9, 9)], scale=changed)


_PATH = [(100.0, 150.0), (500.0, 450.0)]


def _at_scale(scale: Any) -> DistanceMeasurement:
    return vehanchor.measure_distance(pool_among_cars(), _PATH, scale=scale)


def test_a_dumped_estimate_is_the_estimate(estimate: vehanchor.GsdEstimate) -> None:
    expected = _at_scale(estimate)
    assert _at_scale(estimate.model_dump()) == expected
    assert _at_scale(estimate.model_dump(mode="json")) == expected


def test_a_measurement_can_be_given_back_as_a_scale(estimate: vehanchor.GsdEstimate) -> None:
    measurement = _at_scale(estimate)
    assert _at_scale(measurement) == measurement
    assert _at_scale(measurement.model_dump()) == measurement


def test_an_estimate_without_a_scale_is_refused(detector: Detector) -> None:
    nothing = vehanchor.estimate_gsd(pool_among_cars(0), detector=detector)
    for scale in (nothing, nothing.model_dump()):
        with pytest.raises(InvalidParameterError, match="without a scale"):
            _at_scale(scale)


def test_two_scales_are_refused(estimate: vehanchor.GsdEstimate) -> None:
    with pytest.raises(InvalidParameterError, match="not both"):
        _measure([(1, 1), (9, 9)], scale=estimate)


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({"gsd_m_per_px": True}, "gsd_m_per_px"),
        ({"gsd_m_per_px": 0.0}, "use a finite number from 0.0001 to 1000"),
        ({"gsd_m_per_px": 1e308}, "use a finite number from 0.0001 to 1000"),
        ({"scale": 0.15}, "scale is a float: .* a number is gsd_m_per_px"),
    ],
)
def test_a_value_that_is_not_a_scale_is_refused(known: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidParameterError, match=words):
        vehanchor.measure_distance(pool_among_cars(), [(1, 1), (9, 9)], **known)


@pytest.mark.parametrize("name", ["scale", "gsd_m_per_px"])
def test_a_scale_excludes_known_lengths(estimate: vehanchor.GsdEstimate, name: str) -> None:
    scale: dict[str, Any] = {"scale": estimate} if name == "scale" else {"gsd_m_per_px": 0.1}
    known_lengths = [(0, 0, 100, 0, 12.0)]
    words = f"give {name} or lines of known length, not both"
    with pytest.raises(InvalidParameterError, match=words):
        vehanchor.measure_distance(
            pool_among_cars(), [(1, 1), (9, 9)], known_lengths=known_lengths, **scale
        )


FOCAL_35MM = 24.0
FOCAL_PX = FOCAL_35MM * np.hypot(1000, 750) / np.hypot(36, 24)
# Metres per pixel; by the given height, the camera is 50 m above the ground.
GROUND = 0.05
# 500 px long.
LINE = [(100.0, 100.0), (500.0, 400.0)]


def _distance(**options: Any) -> Any:
    return vehanchor.measure_distance(blank_image(1000, 750), LINE, gsd_m_per_px=GROUND, **options)


def test_a_roof_is_nearer_to_the_camera_than_the_ground() -> None:
    ground = _distance(height_m=50.0)
    roof = _distance(height_m=50.0, object_height_m=10.0)
    assert ground.distance_m == pytest.approx(25)
    assert roof.distance_m == pytest.approx(20)
    assert roof.gsd_m_per_px == pytest.approx(0.8 * GROUND)


def test_an_object_of_no_height_is_on_the_ground() -> None:
    assert _distance(height_m=50.0, object_height_m=0.0) == _distance(height_m=50.0)


def test_the_cameras_height_adds_to_the_interval_of_a_roof() -> None:
    ground = _distance(height_m=50.0)
    roof = _distance(height_m=50.0, object_height_m=10.0)
    ground_ratio = ground.distance_ci95_high_m / ground.distance_m
    assert roof.distance_ci95_high_m / roof.distance_m > ground_ratio


def test_with_a_lens_the_cameras_height_follows_from_the_scale() -> None:
    roof = _distance(height_m=70.0, focal_35mm=FOCAL_35MM, object_height_m=10.0)
    assert roof.gsd_m_per_px == pytest.approx(GROUND - 10 / FOCAL_PX)


def test_an_area_on_a_roof_is_smaller_by_the_square() -> None:
    image = blank_image(400, 300)
    image[100:200, 120:260] = (200, 60, 40)
    options: dict[str, Any] = {
        "box": (110, 90, 270, 210),
        "gsd_m_per_px": GROUND,
        "height_m": 50.0,
    }
    ground = vehanchor.measure_area(image, **options)
    roof = vehanchor.measure_area(image, object_height_m=10.0, **options)
    assert ground.area_m2 is not None
    assert roof.area_m2 == pytest.approx(0.64 * ground.area_m2)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"object_height_m": 10.0}, InvalidParameterError, "give height_m"),
        ({"object_height_m": 60.0, "height_m": 50.0}, TooObliqueError, "above the camera"),
        ({"object_height_m": -1.0, "height_m": 50.0}, InvalidParameterError, "0 to 1000"),
        ({"object_height_m": float("nan"), "height_m": 50.0}, InvalidParameterError, "finite"),
    ],
)
def test_an_invalid_height_is_refused(
    options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        _distance(**options)


def test_the_command_reads_the_height_of_an_object(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", blank_image(1000, 750))
    ends = ("--point", 100, 100, "--point", 500, 400)
    heights = ("--height", 50, "--object-height", 10)
    words = ["distance", tmp_path / "a.png", *ends, "--gsd", GROUND, "--json", *heights]
    result = CliRunner().invoke(cli.app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["distance_m"] == pytest.approx(20)


@pytest.mark.parametrize("gsd", [0.0001, 0.003, 0.0031, 0.1, 2.9, 50, 1000])
def test_a_measured_scale_of_any_size_has_one_chance(gsd: float) -> None:
    record = _with_measured_scale(gsd)
    usual = _with_measured_scale(0.2)
    assert record.distance_m == pytest.approx(100 * gsd)
    assert record.scale_confidence == pytest.approx(usual.scale_confidence)


def _with_measured_scale(gsd_m_per_px: float) -> DistanceMeasurement:
    """Measure 100 px with a scale that was measured."""
    options = ScaleOptions.of({"gsd_m_per_px": gsd_m_per_px, "gsd_basis": "measured"})
    return vehanchor.measure_distance(pool_among_cars(0), [(10, 10), (110, 10)], options)


@pytest.mark.parametrize("gsd", [0.0001, 0.003, 0.0031, 2.9, 50, 1000])
def test_a_scale_that_no_ruler_can_have_is_not_compared(detector: Detector, gsd: float) -> None:
    with pytest.raises(InvalidParameterError, match=r"rulers are compared from 0.003 to 2.99 m/px"):
        vehanchor.estimate_gsd(pool_among_cars(0), detector=detector, gsd_m_per_px=gsd)
