from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rasterio.transform import Affine

from tests.models import POOL, POOL_RGB, blank_image, pool_among_cars, write_detector
from tests.sam_models import EMPTY, FULL, write_sam
from tests.skill.imagery.files import geotiff
from vehanchor import analyse_area, estimate_gsd, measure_area
from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.detection.detector import Detector
from vehanchor.errors import FrameError, PromptError
from vehanchor.pictures.measurement import MEASURED_RGB, cut_to_objects, draw_area
from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.records import BoundingBox

# Its crop of 256 px has the pool in its middle.
BOX = (410.7, 273.9, 477.3, 382.1)
GSD = 0.15


def _codes(record: AreaMeasurement) -> list[str]:
    return [notice.code for notice in record.warnings]


def _corners(box: BoundingBox | None) -> tuple[float, float, float, float]:
    assert box is not None
    return box.x1_px, box.y1_px, box.x2_px, box.y2_px


def _measure(image: Any, segmenter: Any, **options: Any) -> AreaMeasurement:
    """Measure the pool at a given scale."""
    prompt = {} if "points" in options else {"box": BOX}
    return measure_area(image, segmenter=segmenter, **{**prompt, "gsd_m_per_px": GSD, **options})


@pytest.fixture(scope="module")
def of_pool(detector: Detector, segmenter: Segmenter) -> AreaAnalysis:
    """Analysis of the pool, 48 x 96 px, at the scale of the vehicles around it."""
    return analyse_area(
        pool_among_cars(), box=BOX, detector=detector, segmenter=segmenter, rulers=("vehicles",)
    )


@pytest.fixture(scope="module")
def record(of_pool: AreaAnalysis) -> AreaMeasurement:
    return of_pool.measurement


@pytest.fixture(scope="module")
def estimate(detector: Detector) -> GsdEstimate:
    """Estimate of the same image on its own."""
    return estimate_gsd(pool_among_cars(), detector=detector, rulers=("vehicles",))


@pytest.fixture(scope="module")
def gsd(estimate: GsdEstimate) -> float:
    assert estimate.gsd_m_per_px is not None
    return estimate.gsd_m_per_px


def test_the_record_has_the_estimate_of_its_image(
    record: AreaMeasurement, estimate: GsdEstimate
) -> None:
    assert record.estimate == estimate
    assert record.scale == estimate.scale
    assert record.gsd_m_per_px == estimate.gsd_m_per_px
    assert record.scale_confidence == estimate.confidence
    assert record.mode_length_px == estimate.mode_length_px
    assert record.n_vehicles == 30


def test_a_usable_scale_makes_a_usable_area(record: AreaMeasurement) -> None:
    assert (record.status, record.scale_source, record.warnings) == ("ok", "estimated", ())


def test_the_mask_covers_the_object(of_pool: AreaAnalysis, record: AreaMeasurement) -> None:
    assert record.mask_area_px == of_pool.segmentation.mask.sum()
    assert record.mask_area_px == pytest.approx(48 * 96, rel=0.01)
    assert record.mask_score == pytest.approx(0.9)
    assert _corners(record.bounding_box) == POOL


def test_the_area_is_the_masks_pixels_times_the_scale_squared(
    record: AreaMeasurement, gsd: float
) -> None:
    assert record.area_m2 == pytest.approx(record.mask_area_px * gsd**2)


def test_the_lengths_are_those_of_the_mask_times_the_scale(
    record: AreaMeasurement, gsd: float
) -> None:
    assert record.length_m == pytest.approx(96 * gsd)
    assert record.width_m == pytest.approx(48 * gsd)
    assert record.inscribed_diameter_m == pytest.approx(48 * gsd)
    # The corners of the mask are round.
    assert record.perimeter_m == pytest.approx(288 * gsd, rel=0.03)


def test_the_centre_of_the_inscribed_circle_is_on_the_middle_line(
    record: AreaMeasurement,
) -> None:
    assert record.inscribed_center is not None
    assert record.inscribed_center.x_px == 444
    assert 280 + 24 <= record.inscribed_center.y_px <= 376 - 24


def test_the_record_names_its_segmenter(record: AreaMeasurement, segmenter: Segmenter) -> None:
    assert (record.segmenter, record.segmenter_sha256) == ("encoder", segmenter.card.sha256)


def test_the_analysis_keeps_the_detections(of_pool: AreaAnalysis) -> None:
    assert of_pool.scale is not None
    assert len(of_pool.scale.detections.boxes) == 30


def test_the_outline_is_in_the_images_pixels(segmenter: Segmenter) -> None:
    (polygon,) = _measure(pool_among_cars(), segmenter).outline
    xs = [point.x_px for point in polygon.exterior.points]
    ys = [point.y_px for point in polygon.exterior.points]
    assert (min(xs), min(ys), max(xs), max(ys)) == POOL
    assert polygon.holes == ()


@pytest.fixture(scope="module")
def at_given_scale(segmenter: Segmenter) -> AreaMeasurement:
    """Record of a call whose detector does not exist."""
    return _measure(pool_among_cars(0), segmenter, detector="there is none.onnx")


def test_a_given_scale_needs_no_detector(at_given_scale: AreaMeasurement) -> None:
    area_m2 = at_given_scale.mask_area_px * GSD**2
    assert at_given_scale.area_m2 == pytest.approx(area_m2)
    assert (at_given_scale.status, at_given_scale.scale_source) == ("ok", "given")
    assert at_given_scale.gsd_m_per_px == GSD


def test_a_given_scale_has_no_evidence(at_given_scale: AreaMeasurement) -> None:
    assert at_given_scale.scale_confidence is None
    assert at_given_scale.n_vehicles is None
    assert at_given_scale.mode_length_px is None
    assert at_given_scale.scale is None


@pytest.fixture(scope="module")
def without_scale(detector: Detector, segmenter: Segmenter) -> AreaMeasurement:
    """Record of an image without vehicles."""
    return _measure(pool_among_cars(0), segmenter, detector=detector, gsd_m_per_px=None)


def test_without_vehicles_there_are_no_metres(without_scale: AreaMeasurement) -> None:
    assert (without_scale.status, without_scale.scale_confidence) == ("no_scale", 0.0)
    assert without_scale.n_vehicles == 0
    metric = {
        name: value
        for name, value in without_scale.model_dump().items()
        if name.endswith(("_m2", "_m", "_per_px"))
    }
    assert len(metric) == 11
    assert set(metric.values()) == {None}
    assert "NaN" not in without_scale.model_dump_json()


def test_without_a_scale_there_is_still_a_mask(without_scale: AreaMeasurement) -> None:
    assert without_scale.mask_area_px > 4500
    assert _corners(without_scale.bounding_box) == POOL
    assert without_scale.outline


def test_a_mask_with_a_low_score_has_low_confidence(tmp_path: Path) -> None:
    doubting = write_sam(tmp_path, scores=[0.4])
    record = _measure(pool_among_cars(), doubting)
    assert (record.status, _codes(record)) == ("low_confidence", ["mask_score_low"])
    assert record.area_m2 is not None


def test_the_model_sets_the_lowest_score(tmp_path: Path) -> None:
    trusting = write_sam(tmp_path, scores=[0.4], metadata={"vehanchor.min_score": "0.3"})
    assert _measure(pool_among_cars(), trusting).status == "ok"


def test_an_empty_mask_has_no_size(tmp_path: Path) -> None:
    record = _measure(pool_among_cars(), write_sam(tmp_path, masks=[EMPTY]))
    assert (record.status, record.area_m2, record.mask_area_px) == ("low_confidence", None, 0)
    assert (record.bounding_box, record.outline, record.inscribed_center) == (None, (), None)
    assert _codes(record) == ["mask_empty"]


def _measure_with_error(
    folder: Path, mask_log_sd: float, *, width_log_sd: float = 0, **options: Any
) -> AreaMeasurement:
    """Measure with a segmenter whose areas and widths have a known error."""
    metadata = {
        "vehanchor.mask_area_log_sd": str(mask_log_sd),
        "vehanchor.mask_width_log_sd": str(width_log_sd),
    }
    files = write_sam(folder, metadata=metadata)
    return measure_area(pool_among_cars(), box=BOX, segmenter=files, **options)


def _log_reach(value: float | None, high: float | None) -> float:
    assert value is not None
    assert high is not None
    return math.log(high / value)


def _area_reach(record: AreaMeasurement) -> float:
    return _log_reach(record.area_m2, record.area_ci95_high_m2)


def test_at_a_given_scale_the_interval_is_that_of_the_mask(tmp_path: Path) -> None:
    record = _measure_with_error(tmp_path, 0.08, gsd_m_per_px=GSD)
    assert _area_reach(record) == pytest.approx(1.96 * 0.08, rel=1e-3)


def test_the_circle_has_the_interval_of_the_masks_outline(tmp_path: Path) -> None:
    record = _measure_with_error(tmp_path, 0.08, gsd_m_per_px=GSD)
    reach = _log_reach(record.inscribed_diameter_m, record.inscribed_diameter_ci95_high_m)
    # The circle in a rectangle of 48 x 96 px: 2 * 0.08 * 4608 / (288 * 48).
    assert reach == pytest.approx(1.96 * 0.0533, rel=0.03)


def test_the_circle_has_at_least_the_error_of_what_fits_into_masks(tmp_path: Path) -> None:
    record = _measure_with_error(tmp_path, 0.08, width_log_sd=0.15, gsd_m_per_px=GSD)
    reach = _log_reach(record.inscribed_diameter_m, record.inscribed_diameter_ci95_high_m)
    assert reach == pytest.approx(1.96 * 0.15, rel=0.01)


def test_with_an_exact_mask_the_interval_is_twice_the_scales(
    detector: Detector, tmp_path: Path
) -> None:
    record = _measure_with_error(tmp_path, 0.0, detector=detector)
    assert record.scale is not None
    scale_reach = _log_reach(record.scale.gsd_m_per_px, record.scale.gsd_ci95_high_m_per_px)
    assert _area_reach(record) == pytest.approx(2 * scale_reach)


def test_the_interval_joins_scale_and_mask(detector: Detector, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("mask", "scale", "both")]
    for folder in folders:
        folder.mkdir()
    mask_only = _measure_with_error(folders[0], 0.08, gsd_m_per_px=GSD)
    scale_only = _measure_with_error(folders[1], 0.0, detector=detector)
    both = _measure_with_error(folders[2], 0.08, detector=detector)
    expected = math.hypot(_area_reach(mask_only), _area_reach(scale_only))
    assert _area_reach(both) == pytest.approx(expected)


_ON_OBJECT = (248, 100)
_BOX_AROUND = (220, 76, 292, 124)


def _object(*, with_neighbour: bool = False) -> NDArray[np.uint8]:
    """Paint an object; the test's segmenter joins it with its neighbour in a large crop."""
    image = blank_image(512, 512)
    image[80:120, 224:288] = POOL_RGB
    if with_neighbour:
        image[80:120, 310:420] = POOL_RGB
    return image


def test_a_point_measures_the_object_on_which_it_is(segmenter: Segmenter) -> None:
    record = _measure(_object(), segmenter, points=[_ON_OBJECT])
    assert _corners(record.bounding_box) == (224, 80, 288, 120)
    # The masks of all crops agree.
    assert record.status == "ok"


def test_a_single_crop_of_points_has_low_confidence(segmenter: Segmenter) -> None:
    record = _measure(_object(), segmenter, points=[_ON_OBJECT])
    # Only one crop contains both points.
    far_apart = [(*_ON_OBJECT, True), (20, 500, False)]
    again = _measure(_object(), segmenter, points=far_apart)
    assert again.mask_area_px == pytest.approx(record.mask_area_px, rel=0.05)
    assert again.status == "low_confidence"


def test_a_point_whose_masks_differ_has_low_confidence(segmenter: Segmenter) -> None:
    record = _measure(_object(with_neighbour=True), segmenter, points=[_ON_OBJECT])
    assert record.status == "low_confidence"
    assert record.alternatives
    assert "extent_unknown" in _codes(record)


def test_a_box_separates_an_object_from_its_neighbour(segmenter: Segmenter) -> None:
    record = _measure(_object(with_neighbour=True), segmenter, box=_BOX_AROUND)
    assert record.status == "ok"


@pytest.mark.parametrize(
    ("score", "prompt", "log_sd"),
    [
        (0.9, {"box": _BOX_AROUND}, 0.1),
        (0.9, {"points": [_ON_OBJECT]}, 0.25),
        (0.6, {"points": [_ON_OBJECT]}, 1.3),
    ],
)
def test_the_interval_depends_on_the_prompt(
    score: float, prompt: dict[str, Any], log_sd: float, tmp_path: Path
) -> None:
    record = _measure(_object(), write_sam(tmp_path, scores=[score]), **prompt)
    width = _log_reach(record.area_ci95_low_m2, record.area_ci95_high_m2)
    assert width / (2 * 1.96) == pytest.approx(log_sd, rel=0.01)


def test_an_object_at_the_images_edge_is_a_lower_bound(segmenter: Segmenter) -> None:
    image = pool_among_cars(0, (752, 280, 800, 376))
    record = _measure(image, segmenter, box=(742.0, 270.0, 800.0, 386.0))
    assert _codes(record) == ["mask_touches_edge"]
    assert _corners(record.bounding_box)[2] == 800


def test_a_mask_that_leaves_its_box_has_a_warning(tmp_path: Path) -> None:
    record = _measure(pool_among_cars(), write_sam(tmp_path, masks=[FULL]))
    assert _codes(record) == ["mask_leaves_box"]
    assert "89 %" in record.warnings[0].message


def test_separate_pieces_have_a_warning(segmenter: Segmenter) -> None:
    image = pool_among_cars()
    image[344:360, 412:476] = 70
    record = _measure(image, segmenter)
    assert "mask_in_pieces" in _codes(record)
    assert len(record.outline) == 2


def test_a_narrow_object_has_a_warning(segmenter: Segmenter) -> None:
    image = pool_among_cars(0, (444, 280, 452, 376))
    record = _measure(image, segmenter, box=(431.4, 273.9, 457.4, 382.1))
    assert _codes(record) == ["target_small"]


def test_the_warnings_of_the_scale_are_among_them(segmenter: Segmenter, tmp_path: Path) -> None:
    capped = Detector(write_detector(tmp_path / "m.onnx", layout="end2end", cap=10))
    record = _measure(pool_among_cars(), segmenter, detector=capped, gsd_m_per_px=None)
    assert _codes(record) == ["detections_capped"]


def test_the_warnings_of_the_image_are_among_them(segmenter: Segmenter) -> None:
    image = pool_among_cars()
    six_bands = np.concatenate([image, image], axis=2)
    assert _codes(_measure(six_bands, segmenter)) == ["bands_selected"]


@pytest.fixture(scope="module")
def georeferenced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GeoTIFF of 0.15 metres per pixel."""
    path = tmp_path_factory.mktemp("geo") / "a.tif"
    transform = Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)
    return geotiff(path, pool_among_cars(), transform=transform)


@pytest.mark.parametrize(("gsd", "codes"), [(0.15, []), (0.2, ["georeference_differs"])])
def test_a_given_scale_that_contradicts_the_file_has_a_warning(
    georeferenced: Path, segmenter: Segmenter, gsd: float, codes: list[str]
) -> None:
    assert _codes(_measure(georeferenced, segmenter, gsd_m_per_px=gsd)) == codes


_HALF_BOX = tuple(side / 2 for side in BOX)


@pytest.fixture(scope="module")
def in_frame(segmenter: Segmenter) -> AreaMeasurement:
    """Record of a call whose box is in a copy of half the size."""
    return _measure(pool_among_cars(), segmenter, box=_HALF_BOX, frame=(400, 300))


def test_a_prompt_in_a_frame_measures_the_image(
    in_frame: AreaMeasurement, segmenter: Segmenter
) -> None:
    in_image = _measure(pool_among_cars(), segmenter)
    assert in_frame.area_m2 == in_image.area_m2
    assert in_frame.bounding_box == in_image.bounding_box


def test_the_record_has_the_scale_of_the_frame(in_frame: AreaMeasurement) -> None:
    assert in_frame.frame is not None
    assert (in_frame.frame.width_px, in_frame.frame.height_px) == (400, 300)
    assert in_frame.frame.gsd_m_per_px == pytest.approx(2 * GSD)
    assert _corners(in_frame.frame.bounding_box) == tuple(side / 2 for side in POOL)


def test_a_frame_of_another_aspect_ratio_is_refused(segmenter: Segmenter) -> None:
    with pytest.raises(FrameError, match="300"):
        _measure(pool_among_cars(), segmenter, box=_HALF_BOX, frame=(400, 400))


def test_a_point_outside_the_frame_is_refused(segmenter: Segmenter) -> None:
    with pytest.raises(PromptError, match="400 x 300 px frame"):
        _measure(pool_among_cars(), segmenter, points=[(420, 100)], frame=(400, 300))


def test_a_cut_has_a_margin_around_the_prompt(segmenter: Segmenter) -> None:
    analysis = analyse_area(pool_among_cars(0), segmenter=segmenter, box=BOX, gsd_m_per_px=GSD)
    part = cut_to_objects([analysis]).part
    # Half of 109 px around the prompt.
    assert (part.x_px, part.y_px) == (round(BOX[0] - 54.6), round(BOX[1] - 54.6))


def test_a_cut_shows_every_pixel_of_the_mask(segmenter: Segmenter) -> None:
    image = pool_among_cars(0)
    analysis = analyse_area(image, segmenter=segmenter, box=BOX, gsd_m_per_px=GSD)
    cut = cut_to_objects([analysis])._replace(long_side_px=4000)
    part = cut.part
    rows = slice(part.y_px, part.y_px + part.height_px)
    columns = slice(part.x_px, part.x_px + part.width_px)
    # Without the caption below it.
    picture = draw_area(image[rows, columns], analysis, cut=cut)[: 4 * part.height_px]
    tint = np.rint(0.65 * np.array(POOL_RGB) + 0.35 * np.array(MEASURED_RGB))
    is_tinted = (picture == tint).all(axis=2)
    is_outline = (picture == MEASURED_RGB).all(axis=2)
    ys, xs = np.nonzero(is_tinted | is_outline)
    x1, y1, x2, y2 = _corners(analysis.measurement.bounding_box)
    # Four pixels of the picture for each of the image, and the outline's width.
    left = 4 * (x1 - part.x_px)
    top = 4 * (y1 - part.y_px)
    right = 4 * (x2 - part.x_px)
    bottom = 4 * (y2 - part.y_px)
    drawn = (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
    assert drawn == pytest.approx((left, top, right, bottom), abs=4)
    assert is_tinted.sum() == pytest.approx(16 * analysis.measurement.mask_area_px, rel=0.1)


_SMALL_BOX = (282.0, 232.0, 308.0, 258.0)


def test_an_area_that_a_small_error_of_the_box_decides_is_doubted(tmp_path: Path) -> None:
    record = measure_area(
        pool_among_cars(), box=_SMALL_BOX, segmenter=write_sam(tmp_path), gsd_m_per_px=GSD
    )
    assert record.status == "low_confidence"
    assert "mask_depends_on_box" in _codes(record)


def test_the_interval_of_a_small_object_holds_the_error_of_its_box(tmp_path: Path) -> None:
    wider = tuple(np.add(_SMALL_BOX, (-6, -6, 6, 6)).tolist())
    record = measure_area(
        pool_among_cars(), box=wider, segmenter=write_sam(tmp_path), gsd_m_per_px=GSD
    )
    assert record.status == "ok"
    assert _area_reach(record) > 1.3 * 1.96 * 0.1
