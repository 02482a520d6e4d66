"""Analyses as people and other programs take them, and lists of images."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.analyses import make_analysis
from tests.models import car_park
from vehanchor import analyse_area, analyse_distance, analyse_scale
from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.cli.app import app
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.options import ScaleOptions
from vehanchor.pictures.measurement import MEASURED_RGB
from vehanchor.records import GsdEstimate, KnownPlane, Notice, Reason, SceneScaleEstimate
from vehanchor.records.text import ADVICE, advice_for


@pytest.fixture(scope="module")
def cars() -> np.ndarray:
    return car_park(30.0 + np.arange(18) % 3)


def test_the_overlay_and_the_plot_are_those_of_the_command(
    cars: np.ndarray, detector: Detector
) -> None:
    from vehanchor.pictures.scale import draw_overlay

    analysis = analyse_scale(cars, detector=detector)
    assert np.array_equal(analysis.overlay(), draw_overlay(cars, analysis))
    assert len(analysis.plot().axes) >= 1
    png = analysis._repr_png_()
    assert png is not None
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert np.array_equal(shown[:, :, ::-1], analysis.overlay())


def test_an_image_is_read_again_as_it_was_read(cars: np.ndarray, detector: Detector) -> None:
    from vehanchor.options import Reading, ScaleOptions

    swapped = np.ascontiguousarray(cars[:, :, ::-1])
    analysis = analyse_scale(swapped, ScaleOptions(reading=Reading(bgr=True)), detector=detector)
    assert np.array_equal(analysis.overlay(), analyse_scale(cars, detector=detector).overlay())


def test_a_stream_is_shown_once_it_is_given_again(cars: np.ndarray, detector: Detector) -> None:
    data = cv2.imencode(".png", cars[:, :, ::-1])[1].tobytes()
    analysis = analyse_scale(io.BytesIO(data), detector=detector)
    assert analysis._repr_png_() is None
    with pytest.raises(InvalidParameterError, match=r"overlay\(image\)"):
        analysis.overlay()
    assert np.array_equal(analysis.overlay(data), analyse_scale(data, detector=detector).overlay())


def test_vehicles_are_features_that_maps_take(cars: np.ndarray, detector: Detector) -> None:
    analysis = analyse_scale(cars, detector=detector)
    collection: dict[str, Any] = analysis.__geo_interface__
    assert len(collection["features"]) == 18
    for feature, (x, y, length, width, _) in zip(
        collection["features"], analysis.detections.boxes, strict=True
    ):
        (ring,) = feature["geometry"]["coordinates"]
        assert ring[0] == ring[-1]
        assert np.mean(ring[:4], axis=0) == pytest.approx([x, y])
        sides = np.linalg.norm(np.diff(ring[:3], axis=0), axis=1)
        assert sorted(sides) == pytest.approx(sorted([length, width]))
        assert feature["properties"]["kept"]


class _Detections:
    """Supervision's, as far as it is used: it takes these keywords and checks these shapes."""

    def __init__(self, *, xyxy: Any, confidence: Any, class_id: Any, data: dict[str, Any]) -> None:
        n = len(xyxy)
        assert xyxy.shape == (n, 4)
        assert (confidence.shape, class_id.shape) == ((n,), (n,))
        assert data["xyxyxyxy"].shape == (n, 4, 2)
        assert data["class_name"].shape == data["kept"].shape == (n,)
        self.xyxy = xyxy


def test_vehicles_are_detections_of_supervision(
    cars: np.ndarray, detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    analysis = analyse_scale(cars, detector=detector)
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(MissingExtraError, match="pip install supervision"):
        analysis.to_supervision()
    stand_in = ModuleType("supervision")
    stand_in.Detections = _Detections  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "supervision", stand_in)
    boxes = analysis.to_supervision().xyxy
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    assert centres == pytest.approx(analysis.detections.boxes[:, :2], abs=0.01)


class _Masks:
    """Supervision's, as far as an object uses it."""

    def __init__(
        self, *, xyxy: Any, mask: Any, confidence: Any, class_id: Any, data: dict[str, Any]
    ) -> None:
        assert (xyxy.shape, mask.dtype, confidence.shape, class_id.shape) == (
            (1, 4),
            np.bool_,
            (1,),
            (1,),
        )
        self.xyxy = xyxy
        self.mask = mask
        self.data = data

    @classmethod
    def empty(cls) -> str:
        return "empty"


@pytest.fixture(scope="module")
def roof(tmp_path_factory: pytest.TempPathFactory) -> AreaAnalysis:
    image = np.full((200, 300, 3), 90, np.uint8)
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)  # 140 x 80 px
    path = tmp_path_factory.mktemp("roof") / "roof.png"
    cv2.imwrite(str(path), image)
    return analyse_area(path, box=(75, 55, 225, 145), gsd_m_per_px=0.1)


def test_an_area_is_drawn_as_by_the_command_and_shown_in_notebooks(
    roof: AreaAnalysis, tmp_path: Path
) -> None:
    assert isinstance(roof.image, Path)
    words = [
        "measure",
        roof.image,
        "--box",
        75,
        55,
        225,
        145,
        "--gsd",
        0.1,
        "--overlay",
        tmp_path / "o.png",
    ]
    assert CliRunner().invoke(app, list(map(str, words))).exit_code == 0
    written = cv2.imread(str(tmp_path / "o.png"))
    assert written is not None
    assert np.array_equal(written[:, :, ::-1], roof.overlay())
    png = roof._repr_png_()
    assert png is not None
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert np.array_equal(shown, written)
    assert replace(roof, image=None)._repr_png_() is None


def test_an_area_is_a_feature_a_mask_and_an_object_of_supervision(
    roof: AreaAnalysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    feature = roof.__geo_interface__
    mask = roof.full_mask()
    assert feature["type"] == "Feature"
    assert feature["properties"]["area_m2"] == roof.measurement.area_m2
    assert mask.shape == (200, 300)
    assert mask.sum() == roof.measurement.mask_area_px
    assert mask[70:130, 90:210].all()
    stand_in = ModuleType("supervision")
    stand_in.Detections = _Masks  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "supervision", stand_in)
    found = roof.to_supervision()
    assert np.array_equal(found.mask[0], mask)
    assert found.xyxy[0] == pytest.approx([80, 60, 220, 140], abs=3)
    assert found.data["area_m2"][0] == roof.measurement.area_m2
    nothing = replace(roof, measurement=roof.measurement.model_copy(update={"bounding_box": None}))
    assert nothing.to_supervision() == "empty"


def test_a_distance_is_drawn_where_it_lies_as_by_the_command(
    cars: np.ndarray, detector: Detector, tmp_path: Path
) -> None:
    photograph = tmp_path / "cars.png"
    out = tmp_path / "o.png"
    cv2.imwrite(str(photograph), cars[:, :, ::-1])
    line = analyse_distance(photograph, [(100, 300), (220, 300), (220, 340)], gsd_m_per_px=0.1)
    words = ["distance", photograph, "--gsd", 0.1, "--overlay", out]
    for place in ("100 300", "220 300", "220 340"):
        words += ["--point", *place.split()]
    assert CliRunner().invoke(app, list(map(str, words))).exit_code == 0
    written = cv2.imread(str(out))
    assert written is not None
    assert np.array_equal(written[:, :, ::-1], line.overlay())
    # the part from 40 to 280 and from 240 to 360 px, four times enlarged
    assert written.shape[1] == 960
    y, x = np.nonzero((line.overlay()[:480] == MEASURED_RGB).all(axis=2))
    assert (x.min(), x.max()) == pytest.approx((240, 720), abs=8)  # strokes across the ends
    assert (y.min(), y.max()) == pytest.approx((240, 400), abs=10)
    assert line._repr_png_() is not None
    words[words.index(out)] = photograph
    refused = CliRunner().invoke(app, list(map(str, words)))
    assert refused.exit_code == 2
    assert "is one of the images" in refused.stderr


def test_a_size_whose_scale_is_not_to_be_used_or_holds_in_one_place_has_no_bar(
    cars: np.ndarray, detector: Detector
) -> None:
    scale = analyse_scale(
        cars, ScaleOptions.of({"rulers": ("vehicles",)}), detector=detector
    ).estimate.scale
    assert scale is not None
    aside = KnownPlane(tilt_deg=30.0, roll_deg=0.0, focal_length_px=400.0)
    known = [scale.model_copy(update=each) for each in ({}, {"confidence": 0.2}, {"plane": aside})]
    for analyse in (
        lambda given: analyse_distance(cars, [(40, 300), (440, 300)], scale=given),
        lambda given: analyse_area(cars, box=(35, 50, 70, 75), scale=given),
    ):
        pictures = [analyse(given).overlay() for given in known]
        height = round(360 * pictures[0].shape[1] / 480)
        white = [int((picture[:height] == 255).all(axis=2).sum()) for picture in pictures]
        assert white[0] > white[1] + 400  # the bar and its letters
        # nor has a view from aside a bar: it would hold nowhere else
        assert white[0] > white[2] + 400


@pytest.fixture(scope="module")
def estimate() -> GsdEstimate:
    """A usable estimate."""
    boxes = np.array(
        [[50.0 + 60 * (k % 10), 50.0 + 60 * (k // 10), 30 + k % 5, 13, 0.0] for k in range(60)]
    )
    return make_analysis(boxes, 700, 500).estimate


@pytest.mark.parametrize(
    ("changes", "why", "helps"),
    [
        (
            {"reason": "too_few", "n_vehicles": 0},
            "no car was found",
            "draw a line over something of known size",
        ),
        ({"reason": "too_coarse"}, "the vehicles are only 32 px long", ADVICE["too_coarse"].helps),
        (
            {
                "reason": "too_coarse",
                "warnings": (Notice(code="detail_missing", message="It is enlarged."),),
            },
            "the image is enlarged or blurred",
            "send the original image",
        ),
        (
            {"reason": "too_coarse", "n_vehicles": 0},
            "no car was found, and the scene looks too coarse for cars",
            "send the full-resolution image",
        ),
        (
            {"reason": "too_few", "n_vehicles": 1},
            "1 vehicle alone: too little evidence",
            "give the region",
        ),
        (
            {
                "reason": "disagree",
                "warnings": (Notice(code="stretched", message="It is stretched."),),
            },
            "the image is stretched in one direction",
            "send the original image",
        ),
    ],
)
def test_one_reason_has_the_advice_of_what_was_seen(
    estimate: GsdEstimate, changes: dict[str, Any], why: str, helps: str
) -> None:
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.why == why
    assert advice.helps.startswith(helps)


def test_a_scene_or_a_ruler_that_contradicts_the_cars_is_named(estimate: GsdEstimate) -> None:
    scene = SceneScaleEstimate(
        gsd_m_per_px=0.39, gsd_ci95_low_m_per_px=0.3, gsd_ci95_high_m_per_px=0.5
    )
    details = estimate.details.model_copy(update={"scene_scale": scene})
    by_scene = advice_for(estimate.model_copy(update={"reason": "disagree", "details": details}))
    assert by_scene is not None
    assert by_scene.why.startswith("the scene suggests a scale of about 0.39 m/px")
    (cars,) = estimate.rulers
    line = cars.model_copy(update={"label": "known length"})
    by_line = advice_for(estimate.model_copy(update={"reason": "disagree", "rulers": (cars, line)}))
    assert by_line is not None
    assert by_line.why == f"{cars.label} and known length contradict each other"


def test_every_reason_has_advice_that_names_nothing_unknown(estimate: GsdEstimate) -> None:
    assert advice_for(estimate) is None
    for reason in get_args(Reason):
        for number in (0, 1, 9):
            advice = advice_for(
                estimate.model_copy(update={"reason": reason, "n_vehicles": number})
            )
            assert advice is not None
            assert "{" not in "".join(advice)
            assert "overlay" not in "".join(advice), "measure_distance has none"
