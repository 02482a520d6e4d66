"""Shapes of the caller's own: what is read, what is refused, and what is measured."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.skill.imagery.files import HEIGHT_PX, WIDTH_PX, jpeg_with, png_with, tiff_with
from tests.skill.imagery.test_raster import UPRIGHT
from vehanchor import analyse_areas, measure_areas
from vehanchor.errors import ImageTooLargeError, PromptError
from vehanchor.measure.shapes import MAX_SHAPES, CallerMask, CallerPolygon, read_shapes
from vehanchor.options import ImageLimits
from vehanchor.records import AreaMeasurement

GSD = 0.1
IMAGE = np.random.default_rng(8).integers(0, 256, (120, 200, 3), np.uint8)
# 60 x 40 px.
RECTANGLE = [(20, 30), (80, 30), (80, 70), (20, 70)]
FLAT = [20, 30, 80, 30, 80, 70, 20, 70]
HOLE = [(40, 40), (40, 60), (60, 60), (60, 40)]
MASK = np.zeros((120, 200), dtype=bool)
MASK[30:70, 20:80] = True
CLOSED = [[*RECTANGLE, RECTANGLE[0]]]
GEOMETRY = {"type": "Polygon", "coordinates": CLOSED}
FEATURE = {"type": "Feature", "geometry": GEOMETRY, "properties": {"name": "roof"}}
RUNS = {
    "size": [120, 200],
    "counts": [20 * 120 + 30, *[40, 80] * 59, 40, 50 + 120 * 120],
}


class _Geometry:
    """Object with the interface of geometries."""

    __geo_interface__ = GEOMETRY


class _Compact:
    """Compact masks of supervision, as far as they are used."""

    image_shape = (120, 200)
    offsets = np.array([(20, 30), (25, 30)])

    def __len__(self) -> int:
        return 2

    def crop(self, index: int) -> np.ndarray:
        return np.ones((40, 60 - 5 * index), dtype=bool)


class _Detections(NamedTuple):
    """Detections of supervision, as far as they are used."""

    mask: Any
    data: dict[str, Any]
    xyxy: Any = np.zeros((2, 4))


def _measure(shapes: Any, image: Any = IMAGE, **options: Any) -> AreaMeasurement:
    (record,) = measure_areas(image, shapes, gsd_m_per_px=GSD, **options)
    return record


# --- What is measured


@pytest.mark.parametrize(
    "shapes",
    [
        [RECTANGLE],
        [np.array(RECTANGLE)],
        [FLAT],
        [np.array(FLAT)],
        [[FLAT]],
        MASK,
        MASK[None],
        [MASK],
        [MASK.astype(np.uint8) * 255],
        [MASK.astype(np.float32)],
        [RUNS],
        RUNS,
        [{"segmentation": RUNS}],
        [{"segmentation": [FLAT]}],
        [{"segmentation": MASK, "area": 2400}],
        GEOMETRY,
        FEATURE,
        {"type": "FeatureCollection", "features": [FEATURE]},
        [_Geometry()],
        _Geometry(),
        _Detections(MASK[None], {}),
        _Detections(None, {"xyxyxyxy": np.array([RECTANGLE])}),
    ],
    ids=lambda shapes: repr(shapes)[:40],
)
def test_each_kind_of_shape_has_its_area(shapes: Any) -> None:
    assert _measure(shapes).area_m2 == pytest.approx(24.0)


def test_compact_masks_are_measured_crop_by_crop() -> None:
    records = measure_areas(IMAGE, _Detections(_Compact(), {}), gsd_m_per_px=GSD)
    assert [record.mask_area_px for record in records] == [2400, 2200]
    assert records[1].bounding_box is not None
    assert records[1].bounding_box.x1_px == 25


def test_geometries_of_shapely_are_read() -> None:
    shapely = pytest.importorskip("shapely.geometry")
    parts = shapely.MultiPolygon([(RECTANGLE, [HOLE]), ([(100, 30), (120, 30), (110, 50)], [])])
    record = _measure([parts])
    assert record.polygon_area_px == pytest.approx(2400 - 400 + 200)
    assert [len(piece.holes) for piece in record.outline] == [1, 0]


def test_the_parts_of_a_polygon_of_coco_count_together() -> None:
    second = [100, 30, 120, 30, 120, 40, 100, 40]
    assert _measure([[FLAT, second]]).polygon_area_px == 2600


def test_a_polygon_between_pixels_has_the_area_of_its_corners() -> None:
    record = _measure([[(20.25, 30.5), (79.75, 30.5), (79.75, 70.25), (20.25, 70.25)]])
    assert record.polygon_area_px == pytest.approx(59.5 * 39.75)
    assert record.area_m2 == pytest.approx(59.5 * 39.75 * GSD**2)


def test_the_largest_circle_of_a_small_polygon_is_found_between_pixels() -> None:
    record = _measure([[(20.4, 30.4), (26.2, 30.4), (26.2, 40.4), (20.4, 40.4)]])
    assert record.inscribed_diameter_m == pytest.approx(0.58, abs=0.02)


def test_a_shape_has_neither_score_nor_segmenter() -> None:
    record = _measure([RECTANGLE])
    assert (record.mask_score, record.segmenter, record.segmenter_sha256) == (None, None, None)
    assert (record.status, record.polygon_area_px) == ("ok", 2400)
    assert _measure(MASK).polygon_area_px is None


@pytest.mark.parametrize(
    ("shapes", "options", "edge_px"),
    [
        ([RECTANGLE], {}, 0.5),
        (MASK, {}, 1.0),
        ([RECTANGLE], {"edge_px": 2.0}, 2.0),
        ([np.array(RECTANGLE) / 2], {"frame": (100, 60)}, 1.0),
        (MASK[::2, ::2], {"frame": (100, 60)}, 2.0),
    ],
    ids=str,
)
def test_the_interval_is_that_of_the_edge_each_way(
    shapes: Any, options: dict[str, Any], edge_px: float
) -> None:
    record = _measure(shapes, **options)
    assert record.area_m2 == pytest.approx(24.0)
    assert record.area_ci95_high_m2 is not None
    assert record.perimeter_m == pytest.approx(20, rel=0.02)
    error_m2 = edge_px * GSD * 20
    assert record.area_ci95_high_m2 / 24 == pytest.approx(np.exp(error_m2 / 24), rel=0.01)


def test_an_exact_edge_leaves_the_scales_interval() -> None:
    record = _measure([RECTANGLE], edge_px=0)
    assert record.area_ci95_low_m2 == record.area_m2 == record.area_ci95_high_m2


def test_coordinates_can_be_fractions() -> None:
    fractions = np.array(RECTANGLE) / (200, 120)
    assert _measure([fractions], coordinates="fraction").area_m2 == pytest.approx(24.0)


def test_a_shape_at_the_edge_is_a_lower_bound() -> None:
    record = _measure([[(0, 0), (30, 0), (30, 30), (0, 30)]])
    assert [notice.code for notice in record.warnings] == ["mask_touches_edge"]


def test_several_shapes_have_one_search(monkeypatch: pytest.MonkeyPatch) -> None:
    from vehanchor.analysis.pipeline import analyse_raster

    searches = []

    def count(*arguments: Any, **keywords: Any) -> Any:
        searches.append(arguments)
        return analyse_raster(*arguments, **keywords)

    monkeypatch.setattr("vehanchor.engine.analyse_raster", count)
    records = measure_areas(IMAGE, [RECTANGLE, MASK])
    assert (len(records), len(searches)) == (2, 1)


def test_the_outline_written_is_the_shape_read_again() -> None:
    (analysis,) = analyse_areas(IMAGE, [RECTANGLE], gsd_m_per_px=GSD)
    assert _measure([analysis]).polygon_area_px == 2400
    assert _measure([analysis.measurement]).polygon_area_px == 2400


def test_names_of_features_are_kept() -> None:
    (analysis,) = analyse_areas(IMAGE, FEATURE, gsd_m_per_px=GSD)
    assert analysis.name == "roof"
    assert analysis.__geo_interface__["properties"]["name"] == "roof"


# --- Orientation of the file


def test_masks_of_two_rows_are_no_corners() -> None:
    shapes = read_shapes([np.ones((2, 5), dtype=bool)] * 3)
    assert [type(shape) for shape in shapes] == [CallerMask] * 3


def _stored(orientation: int) -> np.ndarray:
    """A mask of 20 stored pixels at the upper left of the stored image."""
    mask = np.zeros((HEIGHT_PX, WIDTH_PX), dtype=bool)
    mask[2:6, 1:6] = True
    return mask


def _box(record: AreaMeasurement) -> tuple[float, float, float, float]:
    box = record.bounding_box
    assert box is not None
    return box.x1_px, box.y1_px, box.x2_px, box.y2_px


@pytest.mark.parametrize("make", [jpeg_with, png_with, tiff_with])
@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_stored_mask_is_turned_as_the_image(make: Any, orientation: int) -> None:
    upright = UPRIGHT[orientation](_stored(orientation))
    expected = _measure([upright], make(orientation), orientation="oriented")
    record = _measure([_stored(orientation)], make(orientation), orientation="stored")
    assert _box(record) == _box(expected)


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_a_stored_polygon_is_turned_as_the_mask(orientation: int) -> None:
    corners = [(1, 2), (6, 2), (6, 6), (1, 6)]
    image = jpeg_with(orientation)
    by_mask = _measure([_stored(orientation)], image, orientation="stored")
    assert _box(_measure([corners], image, orientation="stored")) == _box(by_mask)


@pytest.mark.parametrize("orientation", [2, 3, 4])
def test_where_the_size_does_not_show_it_the_orientation_must_be_said(orientation: int) -> None:
    with pytest.raises(PromptError, match='say orientation "oriented"'):
        _measure([_stored(orientation)], jpeg_with(orientation))


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_the_size_shows_a_mask_of_stored_pixels(orientation: int) -> None:
    image = jpeg_with(orientation)
    said = _measure([_stored(orientation)], image, orientation="stored")
    assert _box(_measure([_stored(orientation)], image)) == _box(said)


def test_the_orientation_of_a_pillow_image_is_known() -> None:
    pillow = pytest.importorskip("PIL.Image")
    image = pillow.fromarray(IMAGE)
    image.getexif()[274] = 3
    with pytest.raises(PromptError, match="orientation is 3"):
        _measure(MASK, image)


# --- What is refused


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ([], "no shape"),
        (RECTANGLE, "put it into a list"),
        (FLAT, "put it into a list"),
        ("roof", "give a list of shapes"),
        ([7], "shape 1: it is 7: a shape is a polygon"),
        ([FLAT[:-1]], "shape 1: the polygon has an odd number of values"),
        ([FLAT[:4]], "fewer than 3 different corners"),
        ([[(20, 30), (80, float("nan")), (80, 70)]], "NaN"),
        ([[(20, 30), (80, 70), (80, 30), (20, 70)]], "lines cross at 50, 50"),
        ([[(20, 30), (80, 30), (50, 30)]], "no area"),
        ([[(20, 30), (80, 30), (2000, 70)]], "not inside the 200 x 120 px image"),
        ([[(20, 30), (80, 30), (1e300, 70)]], "outside any image"),
        ([[20, 30, 80, 30, 10**400, 70]], "not a list of numbers"),
        ([[(20, 30), (20.2, 30), (20.2, 30.2)]], "covers no pixel"),
        ([[(0, 0), (50, 50), (90, 90), (90, 10), (50, 50), (0, 100)]], "cross in a corner"),
        ([np.tile(RECTANGLE, (2000, 1))], "simplify it to at most 4000"),
        ([RECTANGLE] * (MAX_SHAPES + 1), f"at most {MAX_SHAPES}"),
        (np.zeros((120, 200), bool), "the mask is empty"),
        (MASK[:-1], "the mask has 200 x 119 px, the image 200 x 120"),
        (np.where(MASK, np.nan, 0), "NaN"),
        (np.arange(24000).reshape(120, 200), "several values"),
        (MASK.astype(str), "has the type"),
        ([MASK[None, None]], "use \\[h, w\\]"),
        ([{**RUNS, "size": [200, 120]}], "the mask has 120 x 200 px"),
        ([{"segmentation": []}], "its segmentation is empty"),
        ([{"bbox": [1, 2, 3, 4]}], "it has bbox: a shape is"),
        ([{"type": "Point", "coordinates": [1, 2]}], "the geometry is 'Point'"),
        ({"type": "FeatureCollection", "features": [FEATURE, {}]}, "feature 2: "),
        ({"type": "Polygon", "coordinates": None}, "no valid coordinates"),
        (
            {"type": "Polygon", "coordinates": [CLOSED[0], np.add(HOLE, (80, 0))]},
            "a hole lies outside",
        ),
        (_Detections(None, {}), "neither masks nor oriented boxes"),
    ],
    ids=lambda value: None if isinstance(value, str) else "",
)
def test_bad_shapes_are_refused(shapes: Any, message: str) -> None:
    with pytest.raises(PromptError, match=message):
        measure_areas(IMAGE, shapes, gsd_m_per_px=GSD)


@pytest.mark.parametrize(
    "shapes",
    [[RECTANGLE] * 1000, {"type": "FeatureCollection", "features": [FEATURE] * 1000}],
    ids=["list", "GeoJSON"],
)
def test_no_more_corners_are_compared_than_a_call_may_have(
    monkeypatch: pytest.MonkeyPatch, shapes: Any
) -> None:
    n_compared: list[object] = []
    monkeypatch.setattr("vehanchor.measure.shapes.MAX_CORNERS_OF_ALL", 40)
    monkeypatch.setattr("vehanchor.measure.shapes.find_crossing", n_compared.append)
    with pytest.raises(PromptError, match="more than 40 corners"):
        read_shapes(shapes)
    assert len(n_compared) <= 11


@pytest.mark.parametrize(
    "shape", [{"size": [120, 200], "counts": [0, 1, 23998, 1]}, RECTANGLE], ids=["runs", "polygon"]
)
def test_boxes_far_larger_than_the_image_are_refused(shape: Any) -> None:
    limits = ImageLimits(max_decoded_bytes=100_000)
    with pytest.raises(ImageTooLargeError, match="measure fewer at a time"):
        measure_areas(IMAGE, [shape] * 100, gsd_m_per_px=GSD, limits=limits)


@pytest.mark.parametrize("edge_px", [-1, float("nan"), float("inf"), "wide", True])
def test_a_bad_edge_is_refused(edge_px: Any) -> None:
    with pytest.raises(PromptError, match="edge_px is"):
        _measure([RECTANGLE], edge_px=edge_px)


def test_a_bad_orientation_is_refused() -> None:
    with pytest.raises(PromptError, match="use oriented or stored"):
        _measure(MASK, orientation="upright")


def test_stored_shapes_have_no_frame() -> None:
    with pytest.raises(PromptError, match="leave frame"):
        _measure(MASK, orientation="stored", frame=(100, 60))


def test_the_message_numbers_the_shape() -> None:
    with pytest.raises(PromptError, match="shape 2: the mask is empty"):
        measure_areas(IMAGE, [MASK, ~MASK & MASK], gsd_m_per_px=GSD)


def test_another_reference_system_than_degrees_is_refused() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32631"}}
    collection = {"type": "FeatureCollection", "crs": crs, "features": [FEATURE]}
    with pytest.raises(PromptError, match="reproject it to WGS 84"):
        read_shapes(collection)


def test_a_closed_ring_has_its_corners_once() -> None:
    (shape,) = read_shapes(GEOMETRY)
    assert isinstance(shape, CallerPolygon)
    assert len(shape.parts[0][0]) == 4
