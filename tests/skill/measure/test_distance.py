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
from vehanchor.pictures.scale import write_picture
from vehanchor.records import KnownScale
from vehanchor.segmentation.segmenter import Segmenter

BOX = (410.7, 273.9, 477.3, 382.1)
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}  # quicker: no other network looks at the image


def test_a_distance_is_the_paths_pixels_times_the_scale_of_the_vehicles(detector: Detector) -> None:
    image = pool_among_cars()
    alone: dict[str, Any] = {"detector": detector, **ALONE}
    estimate = vehanchor.estimate_gsd(image, **alone)
    record = vehanchor.measure_distance(image, [(100, 500), (400, 500), (400, 100)], **alone)
    assert estimate.gsd_m_per_px is not None
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert record.length_px == 700
    assert record.distance_m == pytest.approx(700 * estimate.gsd_m_per_px)
    assert record.distance_ci95_low_m is not None
    assert record.distance_ci95_low_m < 700 * estimate.gsd_ci95_low_m_per_px * 1.02
    assert (record.status, record.scale_confidence, record.n_vehicles) == (
        "ok",
        estimate.confidence,
        30,
    )
    assert (record.estimate, record.scale, record.scale_source) == (
        estimate,
        estimate.scale,
        "estimated",
    )


def test_a_known_scale_leaves_the_pointing_as_the_only_doubt() -> None:
    across = vehanchor.measure_distance(
        pool_among_cars(0), [(100, 100), (200, 100)], gsd_m_per_px=0.1
    )
    assert across.distance_m == pytest.approx(10)
    assert across.distance_ci95_low_m == pytest.approx(
        10 * math.exp(-1.96 * math.sqrt(2) / 100), rel=1e-4
    )
    assert (across.status, across.scale_source, across.scale_confidence, across.n_vehicles) == (
        "ok",
        "given",
        None,
        None,
    )
    stop = vehanchor.measure_distance(
        pool_among_cars(0), [(100, 100), (150, 100), (200, 100)], gsd_m_per_px=0.1
    )
    # a stop on the way is no doubt
    assert stop.distance_ci95_high_m == pytest.approx(across.distance_ci95_high_m)


@pytest.mark.parametrize(
    ("path", "options"),
    [
        ([(100, 150), (500, 450)], {}),
        ([(50, 75), (250, 225)], {"frame": (400, 300)}),
        ([(0.125, 0.25), (0.625, 0.75)], {"coordinates": "fraction"}),
        ([(125, 250), (625, 750)], {"coordinates": "per_mille"}),
    ],
)
def test_a_path_means_the_same_in_every_kind_of_coordinates(path: Any, options: Any) -> None:
    record = vehanchor.measure_distance(pool_among_cars(0), path, gsd_m_per_px=0.1, **options)
    assert record.distance_m == pytest.approx(50)
    assert [(point.x_px, point.y_px) for point in record.path] == [(100, 150), (500, 450)]


def test_a_coarser_copy_is_pointed_at_less_exactly() -> None:
    fine = vehanchor.measure_distance(
        pool_among_cars(0), [(100, 150), (500, 450)], gsd_m_per_px=0.1
    )
    path = [(25.0, 37.5), (125.0, 112.5)]
    frame = {"frame": (200, 150)}
    coarse = vehanchor.measure_distance(pool_among_cars(0), path, gsd_m_per_px=0.1, **frame)  # type: ignore[arg-type]
    assert fine.distance_ci95_high_m is not None
    assert coarse.distance_ci95_high_m is not None
    assert math.log(coarse.distance_ci95_high_m / 50) == pytest.approx(
        4 * math.log(fine.distance_ci95_high_m / 50)
    )


def test_no_vehicles_mean_pixels_and_no_metres(detector: Detector) -> None:
    record = vehanchor.measure_distance(
        pool_among_cars(0), [(100, 100), (200, 100)], detector=detector
    )
    assert (record.status, record.scale_confidence, record.distance_m, record.length_px) == (
        "no_scale",
        0,
        None,
        100,
    )
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
            r"in a copy of 1024 x 768 px it would.*or set coordinates to \"per_mille\"",
        ),
        (
            [(1, 1), (1201.5, 5)],
            {},
            "copy of 1280 x 960 px it would be valid: for a copy, give its size as the frame$",
        ),
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
def test_a_path_that_makes_no_sense_is_refused_with_what_may_have_been_meant(
    path: Any, options: Any, words: str
) -> None:
    with pytest.raises(PromptError, match=words):
        vehanchor.measure_distance(pool_among_cars(0), path, gsd_m_per_px=0.1, **options)


def test_a_box_is_refused_with_what_may_have_been_meant(segmenter: Segmenter) -> None:
    for box, words in (
        ((700, 500, 950, 700), "copy of 1024 x 768"),
        ((0.1, 0.1, 0.4, 0.6), "as fractions"),
    ):
        with pytest.raises(PromptError, match=words):
            vehanchor.measure_area(
                pool_among_cars(0), box=box, gsd_m_per_px=0.1, segmenter=segmenter
            )


def test_a_box_in_shares_of_the_sides_is_the_box_in_pixels(segmenter: Segmenter) -> None:
    in_pixels = vehanchor.measure_area(
        pool_among_cars(0), box=BOX, gsd_m_per_px=0.1, segmenter=segmenter
    )
    x1, y1, x2, y2 = BOX
    share = (x1 / 800, y1 / 600, x2 / 800, y2 / 600)
    assert in_pixels == vehanchor.measure_area(
        pool_among_cars(0), box=share, gsd_m_per_px=0.1, segmenter=segmenter, coordinates="fraction"
    )


def test_a_line_of_known_length_in_shares_of_the_sides_is_the_line_in_pixels(
    detector: Detector,
) -> None:
    in_pixels = vehanchor.estimate_gsd(
        pool_among_cars(), detector=detector, known_lengths=[(80, 60, 480, 360, 80)]
    )
    shares = [(0.1, 0.1, 0.6, 0.6, 80)]
    told = vehanchor.estimate_gsd(
        pool_among_cars(), detector=detector, known_lengths=shares, coordinates="fraction"
    )
    assert told == in_pixels
    assert "known_length" in [ruler.kind for ruler in told.rulers]
    short = [(0.1, 0.1, 0.101, 0.1, 8)]
    with pytest.raises(KnownLengthError, match="px long"):
        vehanchor.estimate_gsd(
            pool_among_cars(), detector=detector, known_lengths=short, coordinates="fraction"
        )


# --- A scale that is given back
# --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def estimate(detector: Detector) -> vehanchor.GsdEstimate:
    return vehanchor.estimate_gsd(pool_among_cars(), detector=detector, **ALONE)


def test_a_distance_and_an_area_have_the_skewed_interval_of_their_scale(
    estimate: vehanchor.GsdEstimate, tmp_path: Path
) -> None:
    assert estimate.scale is not None
    scale = estimate.scale.model_copy(
        update={
            "gsd_m_per_px": 0.136,
            "gsd_ci95_low_m_per_px": 0.121,
            "gsd_ci95_high_m_per_px": 0.185,
        }
    )
    line = vehanchor.measure_distance(pool_among_cars(), [(20, 580), (780, 580)], scale=scale)
    pointing = math.sqrt(2) / 760 * 1.96
    low = math.hypot(math.log(136 / 121), pointing)
    high = math.hypot(math.log(185 / 136), pointing)
    assert line.distance_ci95_low_m == pytest.approx(760 * 0.136 * math.exp(-low), rel=1e-4)
    assert line.distance_ci95_high_m == pytest.approx(760 * 0.136 * math.exp(high), rel=1e-4)
    exact = write_sam(tmp_path, metadata={"vehanchor.mask_area_log_sd": "0"})
    roof = vehanchor.measure_area(pool_among_cars(), box=BOX, segmenter=exact, scale=scale)
    assert roof.area_m2 is not None
    assert roof.area_ci95_low_m2 == pytest.approx(roof.area_m2 * (121 / 136) ** 2)
    assert roof.area_ci95_high_m2 == pytest.approx(roof.area_m2 * (185 / 136) ** 2)
    assert roof.inscribed_diameter_m is not None
    assert roof.inscribed_diameter_ci95_high_m == pytest.approx(
        roof.inscribed_diameter_m * 185 / 136
    )


def test_a_scale_given_back_needs_no_detector_and_keeps_interval_and_confidence(
    estimate: vehanchor.GsdEstimate, detector: Detector, segmenter: Segmenter
) -> None:
    assert isinstance(estimate.scale, KnownScale)
    nowhere = "there is none.onnx"
    path = [(100.0, 500.0), (400.0, 500.0)]
    searched = vehanchor.measure_distance(pool_among_cars(), path, detector=detector, **ALONE)
    reused = vehanchor.measure_distance(
        pool_among_cars(), path, scale=estimate.scale, detector=nowhere
    )
    assert (reused.scale_source, reused.estimate, reused.n_vehicles) == ("reused", None, None)
    assert reused.scale == estimate.scale
    same = (
        "distance_m",
        "distance_ci95_low_m",
        "distance_ci95_high_m",
        "scale_confidence",
        "status",
        "gsd_m_per_px",
    )
    assert [getattr(reused, name) for name in same] == [getattr(searched, name) for name in same]
    area = vehanchor.measure_area(
        pool_among_cars(), box=BOX, segmenter=segmenter, detector=detector, **ALONE
    )
    again = vehanchor.measure_area(
        pool_among_cars(), box=BOX, segmenter=segmenter, scale=estimate, detector=nowhere
    )
    same = (
        "area_m2",
        "area_ci95_low_m2",
        "inscribed_diameter_ci95_high_m",
        "scale_confidence",
        "status",
        "warnings",
    )
    assert [getattr(again, name) for name in same] == [getattr(area, name) for name in same]
    assert again.scale_source == "reused"


def test_a_scale_is_refused_for_another_image(estimate: vehanchor.GsdEstimate) -> None:
    other = pool_among_cars()
    other[599, 799] += 1  # a single pixel
    with pytest.raises(ScaleMismatchError, match="measured on another image") as refused:
        vehanchor.measure_distance(other, [(1, 1), (99, 99)], scale=estimate)
    assert refused.value.code == "scale_mismatch"


SIZES = ("gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        *(
            (change, "scale is not what an estimate gave")
            for change in ({"gsd_m_per_px": -1}, {"confidence": 2})
        ),
        *(
            (change, "scale is not what an estimate gave")
            for change in ({"image_id": None}, {"more": 1})
        ),
        ({"gsd_ci95_high_m_per_px": 0.001}, "scale is not what an estimate gave"),
        (dict.fromkeys(SIZES, 1e308), "no image has"),  # too large to be squared
    ],
)
def test_six_fields_without_meaning_are_refused(
    estimate: vehanchor.GsdEstimate, change: dict[str, Any], words: str
) -> None:
    assert estimate.scale is not None
    with pytest.raises(InvalidParameterError, match=words):
        vehanchor.measure_distance(
            pool_among_cars(), [(1, 1), (9, 9)], scale={**estimate.scale.model_dump(), **change}
        )


def test_a_dumped_estimate_is_the_estimate(
    estimate: vehanchor.GsdEstimate, detector: Detector
) -> None:
    image = pool_among_cars()
    path = [(100.0, 150.0), (500.0, 450.0)]
    given = vehanchor.measure_distance
    expected = given(image, path, scale=estimate)
    assert given(image, path, scale=estimate.model_dump()) == expected
    assert given(image, path, scale=estimate.model_dump(mode="json")) == expected
    measured: Any = expected  # a measurement has the scale to give back, too
    assert (
        given(image, path, scale=measured)
        == given(image, path, scale=expected.model_dump())
        == expected
    )
    nothing = vehanchor.estimate_gsd(pool_among_cars(0), detector=detector)
    for known in (nothing, nothing.model_dump()):
        with pytest.raises(InvalidParameterError, match="without a scale"):
            given(pool_among_cars(0), path, scale=known)


def test_two_scales_are_one_too_many(estimate: vehanchor.GsdEstimate) -> None:
    with pytest.raises(InvalidParameterError, match="not both"):
        vehanchor.measure_distance(
            pool_among_cars(), [(1, 1), (9, 9)], scale=estimate, gsd_m_per_px=0.1
        )


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({"gsd_m_per_px": True}, "gsd_m_per_px"),
        ({"gsd_m_per_px": 0.0}, "use a finite number from 0.0001 to 1000"),
        ({"gsd_m_per_px": 1e308}, "use a finite number from 0.0001 to 1000"),
        ({"scale": 0.15}, "scale is a float: .* a number is gsd_m_per_px"),
    ],
)
def test_what_is_no_scale_is_told(known: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidParameterError, match=words):
        vehanchor.measure_distance(pool_among_cars(), [(1, 1), (9, 9)], **known)


def test_a_known_scale_leaves_no_line_unheard(estimate: vehanchor.GsdEstimate) -> None:
    for known in ({"scale": estimate}, {"gsd_m_per_px": 0.1}):
        with pytest.raises(
            InvalidParameterError,
            match=f"give {next(iter(known))} or lines of known length, not both",
        ):
            vehanchor.measure_distance(
                pool_among_cars(), [(1, 1), (9, 9)], known_lengths=[(0, 0, 100, 0, 12.0)], **known
            )


FOCAL_35MM = 24.0
FOCAL_PX = FOCAL_35MM * np.hypot(1000, 750) / np.hypot(36, 24)
GROUND = 0.05  # metres per pixel: the camera is 50 m up by the given height
LINE = [(100.0, 100.0), (500.0, 400.0)]  # 500 px


def _distance(**options: Any) -> Any:
    return vehanchor.measure_distance(blank_image(1000, 750), LINE, gsd_m_per_px=GROUND, **options)


def test_a_roof_is_shorter_than_the_same_pixels_on_the_ground_by_its_share_of_the_cameras_height() -> (
    None
):
    ground = _distance(height_m=50.0)
    roof = _distance(height_m=50.0, object_height_m=10.0)
    assert ground.distance_m == pytest.approx(25)
    assert (roof.distance_m, roof.gsd_m_per_px) == (pytest.approx(20), pytest.approx(0.8 * GROUND))
    assert _distance(height_m=50.0, object_height_m=0.0) == ground
    assert (
        roof.distance_ci95_high_m / roof.distance_m
        > ground.distance_ci95_high_m / ground.distance_m
    )


def test_with_a_lens_the_cameras_height_is_that_of_the_scale() -> None:
    roof = _distance(height_m=70.0, focal_35mm=FOCAL_35MM, object_height_m=10.0)
    assert roof.gsd_m_per_px == pytest.approx(GROUND - 10 / FOCAL_PX)


def test_an_area_on_a_roof_is_smaller_by_the_square() -> None:
    image = blank_image(400, 300)
    image[100:200, 120:260] = (200, 60, 40)
    common: dict[str, Any] = {"box": (110, 90, 270, 210), "gsd_m_per_px": GROUND, "height_m": 50.0}
    more_options: tuple[dict[str, Any], ...] = ({}, {"object_height_m": 10.0})
    ground, roof = (vehanchor.measure_area(image, **common, **more) for more in more_options)
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
def test_a_height_that_means_nothing_is_refused(
    options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        _distance(**options)


def test_the_commands_take_it(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", blank_image(1000, 750))
    ends = ["--point", 100, 100, "--point", 500, 400]
    asked = [
        "distance",
        tmp_path / "a.png",
        *ends,
        "--gsd",
        GROUND,
        "--json",
        "--height",
        50,
        "--object-height",
        10,
    ]
    result = CliRunner().invoke(cli.app, [str(each) for each in asked])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["distance_m"] == pytest.approx(20)
