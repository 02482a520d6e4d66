"""Analyses with drawing and export, and the advice on their reasons."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.analyses import make_analysis
from tests.models import car_park
from vehanchor import analyse_area, analyse_distance, analyse_scale
from vehanchor.analysis.journal_classes import FORMER_NAMES, STORED_CLASSES
from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
from vehanchor.analysis.memory import AnalysisMemory
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.cli.app import app
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.pictures.measurement import MEASURED_RGB
from vehanchor.records import (
    ExpectedGain,
    GsdEstimate,
    KnownPlane,
    KnownScale,
    Notice,
    Reason,
    Remedy,
    SceneScaleEstimate,
)
from vehanchor.records.advice import IN_WORDS, advice_for
from vehanchor.scale.posterior import Witness
from vehanchor.storage.codec import Codec


@pytest.fixture(scope="module")
def cars() -> np.ndarray:
    return car_park(30.0 + np.arange(18) % 3)


@pytest.fixture(scope="module")
def analysis(cars: np.ndarray, detector: Detector) -> ScaleAnalysis:
    """Analysis of the cars."""
    return analyse_scale(cars, detector=detector)


def _decoded(png: bytes | None) -> np.ndarray:
    """Pixels of a PNG, RGB."""
    assert png is not None
    bgr = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return np.asarray(bgr[:, :, ::-1])


def test_the_overlay_is_that_of_the_command(cars: np.ndarray, analysis: ScaleAnalysis) -> None:
    from vehanchor.pictures.scale import draw_overlay

    assert np.array_equal(analysis.overlay(), draw_overlay(cars, analysis))


def test_an_analysis_has_a_plot(analysis: ScaleAnalysis) -> None:
    assert len(analysis.plot().axes) >= 1


def test_notebooks_show_the_overlay(analysis: ScaleAnalysis) -> None:
    assert np.array_equal(_decoded(analysis._repr_png_()), analysis.overlay())


def test_an_image_is_read_again_with_the_same_options(cars: np.ndarray, detector: Detector) -> None:
    from vehanchor.options import Reading, ScaleOptions

    swapped = np.ascontiguousarray(cars[:, :, ::-1])
    analysis = analyse_scale(swapped, ScaleOptions(reading=Reading(bgr=True)), detector=detector)
    assert np.array_equal(analysis.overlay(), analyse_scale(cars, detector=detector).overlay())


@pytest.fixture(scope="module")
def png(cars: np.ndarray) -> bytes:
    """The cars as a PNG."""
    return cv2.imencode(".png", cars[:, :, ::-1])[1].tobytes()


def test_a_stream_is_not_kept_for_pictures(png: bytes, detector: Detector) -> None:
    analysis = analyse_scale(io.BytesIO(png), detector=detector)
    assert analysis._repr_png_() is None
    with pytest.raises(InvalidParameterError, match=r"overlay\(image\)"):
        analysis.overlay()


def test_the_image_of_a_stream_can_be_given_again(png: bytes, detector: Detector) -> None:
    analysis = analyse_scale(io.BytesIO(png), detector=detector)
    assert np.array_equal(analysis.overlay(png), analyse_scale(png, detector=detector).overlay())


def test_vehicles_are_features_of_geojson(analysis: ScaleAnalysis) -> None:
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
    """Stand-in for supervision's class, with the keywords and shapes that vehicles need."""

    def __init__(self, *, xyxy: Any, confidence: Any, class_id: Any, data: dict[str, Any]) -> None:
        n = len(xyxy)
        assert xyxy.shape == (n, 4)
        assert (confidence.shape, class_id.shape) == ((n,), (n,))
        assert data["xyxyxyxy"].shape == (n, 4, 2)
        assert data["class_name"].shape == data["kept"].shape == (n,)
        self.xyxy = xyxy


def test_supervision_must_be_installed(
    analysis: ScaleAnalysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "supervision", None)
    with pytest.raises(MissingExtraError, match="pip install supervision"):
        analysis.to_supervision()


def test_vehicles_are_detections_of_supervision(
    analysis: ScaleAnalysis, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in = ModuleType("supervision")
    stand_in.Detections = _Detections  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "supervision", stand_in)
    boxes = analysis.to_supervision().xyxy
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    assert centres == pytest.approx(analysis.detections.boxes[:, :2], abs=0.01)


class _Masks:
    """Stand-in for supervision's class, with the keywords and shapes that an object needs."""

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


@pytest.fixture(scope="module")
def roof_by_command(roof: AreaAnalysis, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Overlay that the command writes, RGB."""
    assert isinstance(roof.image, Path)
    out = tmp_path_factory.mktemp("overlay") / "o.png"
    box = [75, 55, 225, 145]
    words = ["measure", roof.image, "--box", *box, "--gsd", 0.1, "--overlay", out]
    assert CliRunner().invoke(app, [str(word) for word in words]).exit_code == 0
    return _decoded(out.read_bytes())


def test_the_overlay_of_an_area_is_that_of_the_command(
    roof: AreaAnalysis, roof_by_command: np.ndarray
) -> None:
    assert np.array_equal(roof_by_command, roof.overlay())


def test_notebooks_show_the_overlay_of_an_area(
    roof: AreaAnalysis, roof_by_command: np.ndarray
) -> None:
    assert np.array_equal(_decoded(roof._repr_png_()), roof_by_command)


def test_without_its_image_an_area_is_not_shown(roof: AreaAnalysis) -> None:
    assert replace(roof, image=None)._repr_png_() is None


def test_an_area_is_a_feature_of_geojson(roof: AreaAnalysis) -> None:
    feature = roof.__geo_interface__
    assert feature["type"] == "Feature"
    assert feature["properties"]["area_m2"] == roof.measurement.area_m2


def test_the_full_mask_has_the_size_of_the_image(roof: AreaAnalysis) -> None:
    mask = roof.full_mask()
    assert mask.shape == (200, 300)
    assert mask.sum() == roof.measurement.mask_area_px
    assert mask[70:130, 90:210].all()


@pytest.fixture
def _masks_of_supervision(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in = ModuleType("supervision")
    stand_in.Detections = _Masks  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "supervision", stand_in)


@pytest.mark.usefixtures("_masks_of_supervision")
def test_an_area_is_an_object_of_supervision(roof: AreaAnalysis) -> None:
    detections = roof.to_supervision()
    assert np.array_equal(detections.mask[0], roof.full_mask())
    assert detections.xyxy[0] == pytest.approx([80, 60, 220, 140], abs=3)
    assert detections.data["area_m2"][0] == roof.measurement.area_m2


@pytest.mark.usefixtures("_masks_of_supervision")
def test_an_empty_mask_is_no_object_of_supervision(roof: AreaAnalysis) -> None:
    measurement = roof.measurement.model_copy(update={"bounding_box": None})
    assert replace(roof, measurement=measurement).to_supervision() == "empty"


POINTS = [(100, 300), (220, 300), (220, 340)]


@pytest.fixture(scope="module")
def photograph(cars: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cars as a file."""
    path = tmp_path_factory.mktemp("photograph") / "cars.png"
    cv2.imwrite(str(path), cars[:, :, ::-1])
    return path


@pytest.fixture(scope="module")
def line(photograph: Path) -> DistanceAnalysis:
    """Distance along three points."""
    return analyse_distance(photograph, POINTS, gsd_m_per_px=0.1)


def _run_distance(photograph: Path, overlay: Path) -> Result:
    """Measure the same distance by the command."""
    words: list[object] = ["distance", photograph, "--gsd", 0.1, "--overlay", overlay]
    for x, y in POINTS:
        words += ["--point", x, y]
    return CliRunner().invoke(app, [str(word) for word in words])


def test_the_overlay_of_a_distance_is_that_of_the_command(
    photograph: Path, line: DistanceAnalysis, tmp_path: Path
) -> None:
    assert _run_distance(photograph, tmp_path / "o.png").exit_code == 0
    written = _decoded((tmp_path / "o.png").read_bytes())
    assert np.array_equal(written, line.overlay())


def test_a_distance_is_drawn_at_its_place(line: DistanceAnalysis) -> None:
    picture = line.overlay()
    # the part from 40 to 280 and from 240 to 360 px, four times enlarged
    assert picture.shape[1] == 960
    y, x = np.nonzero((picture[:480] == MEASURED_RGB).all(axis=2))
    assert (x.min(), x.max()) == pytest.approx((240, 720), abs=8)  # strokes across the ends
    assert (y.min(), y.max()) == pytest.approx((240, 400), abs=10)


def test_notebooks_show_a_distance(line: DistanceAnalysis) -> None:
    assert line._repr_png_() is not None


def test_an_overlay_never_replaces_the_photograph(photograph: Path) -> None:
    refused = _run_distance(photograph, overlay=photograph)
    assert refused.exit_code == 2
    assert "is one of the images" in refused.stderr


def _draw_distance(image: np.ndarray, scale: KnownScale) -> np.ndarray:
    return analyse_distance(image, [(40, 300), (440, 300)], scale=scale).overlay()


def _draw_area(image: np.ndarray, scale: KnownScale) -> np.ndarray:
    return analyse_area(image, box=(35, 50, 70, 75), scale=scale).overlay()


def _n_white(picture: np.ndarray) -> int:
    """Number of white pixels above the caption: those of the scale bar and its letters."""
    background = picture[-1, 0]
    is_caption = (picture[:, 0] == background).all(axis=1)
    height = int(np.flatnonzero(~is_caption)[-1]) + 1
    return int((picture[:height] == 255).all(axis=2).sum())


@pytest.mark.parametrize("draw", [_draw_distance, _draw_area])
@pytest.mark.parametrize(
    "change",
    [
        {"confidence": 0.2},
        {"plane": KnownPlane(tilt_deg=30.0, roll_deg=0.0, focal_length_px=400.0)},
    ],
    ids=["unusable", "tilted"],
)
def test_an_unusable_or_tilted_scale_has_no_bar(
    cars: np.ndarray,
    detector: Detector,
    draw: Callable[[np.ndarray, KnownScale], np.ndarray],
    change: dict[str, Any],
) -> None:
    options = ScaleOptions.of({"rulers": ("vehicles",)})
    scale = analyse_scale(cars, options, detector=detector).estimate.scale
    assert scale is not None
    with_bar = _n_white(draw(cars, scale))
    without_bar = _n_white(draw(cars, scale.model_copy(update=change)))
    assert with_bar > without_bar + 400


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
            IN_WORDS["line"],
        ),
        ({"reason": "too_coarse"}, "the vehicles are only 32 px long", IN_WORDS["lower"]),
        (
            {
                "reason": "too_coarse",
                "warnings": (Notice(code="detail_missing", message="It is enlarged."),),
            },
            "the image is enlarged or blurred",
            "send the original image",
        ),
        (
            {
                "reason": "too_few",
                "n_vehicles": 1,
                "warnings": (Notice(code="detail_missing", message="It is enlarged."),),
            },
            "the image is enlarged or blurred",
            "send the original image",
        ),
        (
            {"reason": "too_coarse", "n_vehicles": 0},
            "no car was found, and the scene looks too coarse for cars",
            "send the original image",
        ),
        (
            {"reason": "too_few", "n_vehicles": 1},
            "1 vehicle alone: too little evidence",
            IN_WORDS["add"],
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
def test_the_advice_follows_the_evidence(
    estimate: GsdEstimate, changes: dict[str, Any], why: str, helps: str
) -> None:
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.why == why
    assert advice.helps.startswith(helps)


def _gain(remedy: Remedy, confidence: float, *vehicles: int) -> ExpectedGain:
    return ExpectedGain(remedy=remedy, confidence=confidence, gsd_ci95_ratio=1.2, vehicles=vehicles)


@pytest.mark.parametrize(
    ("gains", "remedies"),
    [
        ([_gain("length", 0.97), _gain("line", 0.93)], ("line", "length")),
        ([_gain("length", 0.97), _gain("line", 0.8)], ("length", "line")),
        ([_gain("height", 0.95), _gain("region", 0.55)], ("height",)),
        (
            [_gain("add", 0.93), _gain("line", 0.92), _gain("height", 0.91)],
            ("add", "height", "line"),
        ),
    ],
)
def test_advice_names_what_the_posterior_would_gain_from(
    estimate: GsdEstimate, gains: list[ExpectedGain], remedies: tuple[Remedy, ...]
) -> None:
    details = estimate.details.model_copy(update={"remedies": tuple(gains)})
    changes = {"reason": "imprecise", "confidence": 0.5, "details": details}
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.remedies == remedies


def test_advice_names_doubtful_vehicles_by_their_numbers(estimate: GsdEstimate) -> None:
    details = estimate.details.model_copy(update={"remedies": (_gain("drop", 0.96, 1, 3),)})
    changes = {"reason": "imprecise", "confidence": 0.5, "details": details}
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.helps == "drop vehicles 1, 3 if they are not cars"


def test_a_scene_that_contradicts_the_cars_is_named(estimate: GsdEstimate) -> None:
    scene = SceneScaleEstimate(
        gsd_m_per_px=0.39, gsd_ci95_low_m_per_px=0.3, gsd_ci95_high_m_per_px=0.5
    )
    details = estimate.details.model_copy(update={"scene_scale": scene})
    by_scene = advice_for(estimate.model_copy(update={"reason": "disagree", "details": details}))
    assert by_scene is not None
    assert by_scene.why.startswith("the scene suggests a scale of about 0.39 m/px")


def test_a_ruler_that_contradicts_the_cars_is_named(estimate: GsdEstimate) -> None:
    (cars,) = estimate.rulers
    line = cars.model_copy(update={"label": "known length"})
    notice = Notice(code="rulers_disagree", message="The line gives 0.2 m/px.")
    changes = {"reason": "disagree", "rulers": (cars, line), "warnings": (notice,)}
    by_line = advice_for(estimate.model_copy(update=changes))
    assert by_line is not None
    assert by_line.why == f"{cars.label} and known length contradict each other"


def test_a_usable_scale_needs_no_advice(estimate: GsdEstimate) -> None:
    assert advice_for(estimate) is None


@pytest.mark.parametrize("reason", get_args(Reason))
@pytest.mark.parametrize("n_vehicles", [0, 1, 9])
def test_every_reason_has_advice_without_gaps(
    estimate: GsdEstimate, reason: Reason, n_vehicles: int
) -> None:
    changes = {"reason": reason, "n_vehicles": n_vehicles}
    advice = advice_for(estimate.model_copy(update=changes))
    assert advice is not None
    assert advice.why
    assert advice.remedies
    assert "overlay" not in advice.helps, "measure_distance has none"


def test_journals_with_the_former_name_of_a_statement_are_read() -> None:
    codec = Codec(STORED_CLASSES, FORMER_NAMES)
    stored = json.dumps(codec.dump(Witness("height", n=0, statement="It gives 0.1 m/px.")))
    assert '"statement"' in stored
    witness = codec.load(json.loads(stored.replace('"statement"', '"said"')))
    assert witness.statement == "It gives 0.1 m/px."


def test_equal_pixels_with_other_metadata_have_an_analysis_of_their_own(
    cars: np.ndarray, detector: Detector
) -> None:
    memory = AnalysisMemory()
    options = ScaleOptions()
    metadata = CameraMetadata(
        height_m=50.0, height_tag="height", focal_35mm=24.0, off_nadir_deg=0.0, roll_deg=0.0
    )
    with open_raster(cars) as without, open_raster(cars) as photograph:
        photograph.camera = metadata
        without_camera = memory.analyse(detector, without, options).estimate
        with_camera = memory.analyse(detector, photograph, options).estimate
    assert "camera" not in [ruler.kind for ruler in without_camera.rulers]
    assert "camera" in [ruler.kind for ruler in with_camera.rulers]
