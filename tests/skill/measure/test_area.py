from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.models import POOL, POOL_RGB, blank_image, pool_among_cars, write_detector
from tests.sam_models import EMPTY, write_sam
from vehanchor import analyse_area, estimate_gsd, measure_area
from vehanchor.detection.detector import Detector
from vehanchor.errors import FrameError, PromptError
from vehanchor.pictures.measurement import MEASURED_RGB, cut_to_objects, draw_area
from vehanchor.records import AreaMeasurement
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor.records import BoundingBox

BOX = (410.7, 273.9, 477.3, 382.1)  # its crop of 256 px has the pool in its middle
GSD = 0.15


def _codes(record: AreaMeasurement) -> list[str]:
    return [notice.code for notice in record.warnings]


def _corners(box: BoundingBox | None) -> tuple[float, float, float, float]:
    assert box is not None
    return box.x1_px, box.y1_px, box.x2_px, box.y2_px


def test_the_area_is_the_masks_pixels_times_the_scale_squared(
    detector: Detector, segmenter: Segmenter
) -> None:
    image = pool_among_cars()
    analysis = analyse_area(
        image, box=BOX, detector=detector, segmenter=segmenter, rulers=("vehicles",)
    )
    record = analysis.measurement
    scale = estimate_gsd(image, detector=detector, rulers=("vehicles",))
    assert (record.estimate, record.scale) == (scale, scale.scale)
    assert scale.gsd_m_per_px is not None
    assert record.mask_area_px == analysis.segmentation.mask.sum()
    assert record.mask_area_px == pytest.approx(48 * 96, rel=0.01)
    assert record.area_m2 == pytest.approx(record.mask_area_px * scale.gsd_m_per_px**2)
    assert (record.gsd_m_per_px, record.scale_confidence) == (scale.gsd_m_per_px, scale.confidence)
    assert (record.n_vehicles, record.mode_length_px) == (30, scale.mode_length_px)
    assert (record.status, record.scale_source, record.warnings) == ("ok", "estimated", ())
    assert record.mask_score == pytest.approx(0.9)
    assert _corners(record.bounding_box) == POOL
    assert record.length_m == pytest.approx(96 * scale.gsd_m_per_px)
    assert record.width_m == pytest.approx(48 * scale.gsd_m_per_px)
    assert record.inscribed_diameter_m == pytest.approx(48 * scale.gsd_m_per_px)
    # its corners are round
    assert record.perimeter_m == pytest.approx(288 * scale.gsd_m_per_px, rel=0.03)
    assert record.inscribed_center is not None
    assert record.inscribed_center.x_px == 444
    assert 280 + 24 <= record.inscribed_center.y_px <= 376 - 24
    assert (record.segmenter, record.segmenter_sha256) == ("encoder", segmenter.card.sha256)
    assert analysis.scale is not None
    assert len(analysis.scale.detections.boxes) == 30


def test_the_outline_is_in_the_images_pixels(detector: Detector, segmenter: Segmenter) -> None:
    (polygon,) = measure_area(
        pool_among_cars(), box=BOX, gsd_m_per_px=GSD, segmenter=segmenter
    ).outline
    xs = [p.x_px for p in polygon.exterior.points]
    ys = [p.y_px for p in polygon.exterior.points]
    assert (min(xs), min(ys), max(xs), max(ys)) == POOL
    assert polygon.holes == ()


def test_a_given_scale_needs_no_detector(segmenter: Segmenter, tmp_path: Path) -> None:
    record = measure_area(
        pool_among_cars(0),
        box=BOX,
        gsd_m_per_px=GSD,
        segmenter=segmenter,
        detector=tmp_path / "there is none.onnx",
    )
    assert record.area_m2 == pytest.approx(record.mask_area_px * GSD**2)
    assert (record.status, record.scale_source, record.gsd_m_per_px) == ("ok", "given", GSD)
    assert (record.scale_confidence, record.n_vehicles, record.mode_length_px, record.scale) == (
        None,
        None,
        None,
        None,
    )


def test_no_vehicles_mean_no_area_but_the_mask_all_the_same(
    detector: Detector, segmenter: Segmenter
) -> None:
    record = measure_area(pool_among_cars(0), box=BOX, detector=detector, segmenter=segmenter)
    assert (record.status, record.scale_confidence, record.n_vehicles) == ("no_scale", 0.0, 0)
    metric = {
        name: value
        for name, value in record.model_dump().items()
        if name.endswith(("_m2", "_m", "_per_px"))
    }
    assert len(metric) == 10
    assert set(metric.values()) == {None}
    assert record.mask_area_px > 4500
    assert _corners(record.bounding_box) == POOL
    assert record.outline
    assert "NaN" not in record.model_dump_json()


def test_a_mask_that_the_segmenter_doubts_is_low_confidence(tmp_path: Path) -> None:
    doubting = Segmenter(*write_sam(tmp_path, scores=[0.4]))
    record = measure_area(pool_among_cars(), box=BOX, gsd_m_per_px=GSD, segmenter=doubting)
    assert (record.status, _codes(record)) == ("low_confidence", ["mask_score_low"])
    assert record.area_m2 is not None
    (tmp_path / "trusting").mkdir()
    trusting = Segmenter(
        *write_sam(tmp_path / "trusting", scores=[0.4], metadata={"vehanchor.min_score": "0.3"})
    )
    assert (
        measure_area(pool_among_cars(), box=BOX, gsd_m_per_px=GSD, segmenter=trusting).status
        == "ok"
    )


def test_an_empty_mask_is_no_measurement(tmp_path: Path) -> None:
    blind = Segmenter(*write_sam(tmp_path, masks=[EMPTY]))
    record = measure_area(pool_among_cars(), box=BOX, gsd_m_per_px=GSD, segmenter=blind)
    assert (record.status, record.area_m2, record.mask_area_px) == ("low_confidence", None, 0)
    assert (record.bounding_box, record.outline, record.inscribed_center) == (None, (), None)
    assert _codes(record) == ["mask_empty"]


def test_the_interval_joins_scale_and_mask(detector: Detector, tmp_path: Path) -> None:
    def ratio(log_sd: float, name: str, **options: Any) -> tuple[float, AreaMeasurement]:
        (tmp_path / name).mkdir()
        files = write_sam(tmp_path / name, metadata={"vehanchor.mask_area_log_sd": str(log_sd)})
        record = measure_area(pool_among_cars(), box=BOX, segmenter=files, **options)
        assert record.area_m2 is not None
        assert record.area_ci95_high_m2 is not None
        return math.log(record.area_ci95_high_m2 / record.area_m2), record

    mask_only, record = ratio(0.08, "a", gsd_m_per_px=GSD)
    assert mask_only == pytest.approx(1.96 * 0.08, rel=1e-3)
    # the circle in a 48 x 96 px rectangle: 2 * 0.08 * 4608 / (288 * 48)
    assert record.inscribed_diameter_m is not None
    assert record.inscribed_diameter_ci95_high_m is not None
    reach = math.log(record.inscribed_diameter_ci95_high_m / record.inscribed_diameter_m)
    assert reach == pytest.approx(1.96 * 0.0533, rel=0.03)
    scale_only, record = ratio(0.0, "b", detector=detector)
    assert record.scale is not None
    assert scale_only == pytest.approx(
        2 * math.log(record.scale.gsd_ci95_high_m_per_px / record.scale.gsd_m_per_px)
    )
    both, _ = ratio(0.08, "c", detector=detector)
    assert both == pytest.approx(math.hypot(mask_only, scale_only))


def test_points_measure_what_they_are_on(segmenter: Segmenter) -> None:
    image = blank_image(512, 512)
    image[80:120, 224:288] = POOL_RGB
    record = measure_area(image, points=[(248, 100)], gsd_m_per_px=GSD, segmenter=segmenter)
    assert _corners(record.bounding_box) == (224, 80, 288, 120)
    again = measure_area(
        image, points=[(248, 100, True), (20, 500, False)], gsd_m_per_px=GSD, segmenter=segmenter
    )
    assert again.mask_area_px == pytest.approx(record.mask_area_px, rel=0.05)
    assert record.status == "ok", "the masks of all crops agree"
    assert again.status == "low_confidence", "one crop alone has room for both points"
    image[80:120, 310:420] = POOL_RGB  # the toy network takes both in a large crop
    doubted = measure_area(image, points=[(248, 100)], gsd_m_per_px=GSD, segmenter=segmenter)
    assert doubted.status == "low_confidence"
    assert doubted.alternatives
    assert "extent_unknown" in [each.code for each in doubted.warnings]
    boxed = measure_area(image, box=(220, 76, 292, 124), gsd_m_per_px=GSD, segmenter=segmenter)
    assert boxed.status == "ok"


def test_the_interval_at_a_point_is_wide_and_wider_at_a_low_score(tmp_path: Path) -> None:
    image = blank_image(512, 512)
    image[80:120, 224:288] = POOL_RGB
    widths = []
    for name, score, prompt in (
        ("box", 0.9, {"box": (220, 76, 292, 124)}),
        ("point", 0.9, {"points": [(248, 100)]}),
        ("doubted", 0.6, {"points": [(248, 100)]}),
    ):
        (tmp_path / name).mkdir()
        sam = Segmenter(*write_sam(tmp_path / name, scores=[score]))
        record = measure_area(image, gsd_m_per_px=GSD, segmenter=sam, **prompt)
        assert record.area_ci95_low_m2 is not None
        assert record.area_ci95_high_m2 is not None
        widths.append(math.log(record.area_ci95_high_m2 / record.area_ci95_low_m2) / (2 * 1.96))
    assert widths == pytest.approx([0.1, 0.25, 1.3], rel=0.01)


# --- warnings


def test_what_is_cut_by_the_image_is_a_lower_bound(segmenter: Segmenter) -> None:
    image = pool_among_cars(0, (752, 280, 800, 376))
    record = measure_area(
        image, box=(742.0, 270.0, 800.0, 386.0), gsd_m_per_px=GSD, segmenter=segmenter
    )
    assert _codes(record) == ["mask_touches_edge"]
    assert _corners(record.bounding_box)[2] == 800


def test_a_mask_that_leaves_its_box_is_told(tmp_path: Path) -> None:
    spilling = Segmenter(*write_sam(tmp_path, masks=["full"]))
    record = measure_area(pool_among_cars(), box=BOX, gsd_m_per_px=GSD, segmenter=spilling)
    assert _codes(record) == ["mask_leaves_box"]
    assert "89 %" in record.warnings[0].message


def test_separate_pieces_are_told(segmenter: Segmenter) -> None:
    image = pool_among_cars()
    image[344:360, 412:476] = 70
    record = measure_area(image, box=BOX, gsd_m_per_px=GSD, segmenter=segmenter)
    assert "mask_in_pieces" in _codes(record)
    assert len(record.outline) == 2


def test_a_narrow_object_is_told(segmenter: Segmenter) -> None:
    image = pool_among_cars(0, (444, 280, 452, 376))
    box = (431.4, 273.9, 457.4, 382.1)
    assert _codes(measure_area(image, box=box, gsd_m_per_px=GSD, segmenter=segmenter)) == [
        "target_small"
    ]


def test_the_scales_warnings_and_the_rasters_are_among_them(
    segmenter: Segmenter, tmp_path: Path
) -> None:
    image = pool_among_cars()
    capped = Detector(write_detector(tmp_path / "m.onnx", layout="end2end", cap=10))
    assert _codes(measure_area(image, box=BOX, detector=capped, segmenter=segmenter)) == [
        "detections_capped"
    ]
    bands = np.concatenate([image, image], axis=2)
    assert _codes(measure_area(bands, box=BOX, gsd_m_per_px=GSD, segmenter=segmenter)) == [
        "bands_selected"
    ]


def test_a_given_scale_that_contradicts_the_file_is_told(
    segmenter: Segmenter, tmp_path: Path
) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=800, height=600, count=3, dtype="uint8", crs="EPSG:32631",
        transform=rasterio.Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000),
    ) as dataset:  # fmt: skip
        dataset.write(pool_among_cars().transpose(2, 0, 1))
    for gsd, codes in ((0.15, []), (0.2, ["georeference_differs"])):
        assert _codes(measure_area(path, box=BOX, gsd_m_per_px=gsd, segmenter=segmenter)) == codes


# --- frames


def test_prompts_are_read_in_the_frame_and_answered_in_the_image(segmenter: Segmenter) -> None:
    image = pool_among_cars()
    full = measure_area(image, box=BOX, gsd_m_per_px=GSD, segmenter=segmenter)
    options: dict[str, Any] = {"frame": (400, 300), "segmenter": segmenter}
    half = tuple(side / 2 for side in BOX)
    record = measure_area(image, box=half, gsd_m_per_px=GSD, **options)
    assert record.area_m2 == full.area_m2
    assert record.bounding_box == full.bounding_box
    assert record.frame is not None
    assert (record.frame.width_px, record.frame.height_px) == (400, 300)
    assert record.frame.gsd_m_per_px == pytest.approx(2 * GSD)
    assert _corners(record.frame.bounding_box) == tuple(side / 2 for side in POOL)
    with pytest.raises(FrameError, match="300"):
        measure_area(image, box=half, gsd_m_per_px=GSD, **(options | {"frame": (400, 400)}))
    with pytest.raises(PromptError, match="400 x 300 px frame"):
        measure_area(image, points=[(420, 100)], gsd_m_per_px=GSD, **options)


# --- the record and its picture


def test_a_cut_shows_every_pixel_of_the_mask(segmenter: Segmenter) -> None:
    image = pool_among_cars(0)
    analysis = analyse_area(image, segmenter=segmenter, box=BOX, gsd_m_per_px=GSD)
    cut = cut_to_objects([analysis], 4000)
    part = cut.part
    # half of 109 px around the prompt
    assert (part.x_px, part.y_px) == (round(BOX[0] - 54.6), round(BOX[1] - 54.6))
    seen = image[part.y_px : part.y_px + part.height_px, part.x_px : part.x_px + part.width_px]
    picture = draw_area(seen, analysis, cut=cut)[: 4 * part.height_px]
    tinted = (picture == np.rint(0.65 * np.array(POOL_RGB) + 0.35 * np.array(MEASURED_RGB))).all(
        axis=2
    )
    rows, columns = np.nonzero(tinted | (picture == MEASURED_RGB).all(axis=2))
    box = np.array(_corners(analysis.measurement.bounding_box)).reshape(2, 2) - [
        part.x_px,
        part.y_px,
    ]
    found = columns.min(), rows.min(), columns.max() + 1, rows.max() + 1
    # four picture pixels for each, and the outline's width
    assert found == pytest.approx((4 * box).ravel(), abs=4)
    assert tinted.sum() == pytest.approx(16 * analysis.measurement.mask_area_px, rel=0.1)
