"""Records as other programs read them: tables, notebooks, geometries, texts."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

import vehanchor
from tests.analyses import make_analysis
from tests.conftest import ROOT
from tests.records import CASES, KEPT, records_of, renewed
from vehanchor.errors import MissingExtraError, PromptError
from vehanchor.measure.distance import read_path
from vehanchor.records import (
    SCHEMA_VERSION,
    AreaMeasurement,
    EstimateDetails,
    FrameScale,
    GsdEstimate,
    ImagePoint,
    KnownScale,
    Notice,
    OutlinePolygon,
    OutlineRing,
)
from vehanchor.records.columns import ALL_COLUMNS
from vehanchor.records.flat import flat_columns, flat_row
from vehanchor.records.record import Record
from vehanchor.records.text import significant, with_interval
from vehanchor.scale.defaults import INTERVAL_PREMISE
from vehanchor.segmentation.prompt import read_prompt
from vehanchor_flight.records import FlightPhotograph

# --- Tables


@pytest.fixture(scope="module")
def estimate() -> GsdEstimate:
    """The record of an image with six vehicles."""
    boxes = np.array([[50.0 + 60 * k, 50.0, 30.0 + 0.3 * k, 12.0, 0.0] for k in range(6)])
    return make_analysis(boxes, 600, 300).estimate


@pytest.fixture(scope="module")
def no_estimate() -> GsdEstimate:
    """The record of an image without vehicles."""
    return make_analysis(np.zeros((0, 5)), 600, 300).estimate


def test_a_record_is_one_row_of_single_values(estimate: GsdEstimate) -> None:
    warnings = (Notice(code="a", message="A."), Notice(code="b", message="B."))
    record = estimate.model_copy(update={"warnings": warnings})
    row = flat_row(record)
    assert row["gsd_m_per_px"] == record.gsd_m_per_px
    assert record.details.confidence_terms is not None
    assert row["confidence_terms_sample"] == record.details.confidence_terms.sample
    assert row["warning_codes"] == "a b"
    assert not [value for value in row.values() if isinstance(value, dict | list | tuple)]


def test_a_record_has_at_most_twenty_fields_beside_its_details() -> None:
    assert len(GsdEstimate.model_fields) <= 20
    assert not set(GsdEstimate.model_fields) & set(EstimateDetails.model_fields)


def test_every_record_of_a_type_has_the_same_columns(
    estimate: GsdEstimate, no_estimate: GsdEstimate
) -> None:
    assert estimate.gsd_m_per_px is not None
    assert no_estimate.gsd_m_per_px is None
    columns = list(flat_columns(GsdEstimate))
    assert list(flat_row(estimate)) == columns
    assert list(flat_row(no_estimate)) == columns


def test_a_table_of_a_batch_has_the_columns_of_a_data_frame() -> None:
    columns = set(flat_columns(GsdEstimate, without=("frame",)))
    assert set(ALL_COLUMNS) - {"photograph", "contradiction", "error_code", "error"} == columns


def test_a_missing_pandas_is_named(estimate: GsdEstimate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        estimate.to_frame()


def test_a_data_frame_has_the_values_of_its_record(estimate: GsdEstimate) -> None:
    pytest.importorskip("pandas")
    frame = estimate.to_frame()
    assert len(frame) == 1
    assert frame.gsd_m_per_px[0] == estimate.gsd_m_per_px
    assert frame["ruler_vehicles_gsd_m_per_px"][0] == estimate.rulers[0].gsd_m_per_px


def test_types_of_columns_do_not_depend_on_the_values(
    estimate: GsdEstimate, no_estimate: GsdEstimate
) -> None:
    pytest.importorskip("pandas")
    assert estimate.to_frame().dtypes.equals(no_estimate.to_frame().dtypes)


def test_fields_of_nested_records_are_columns() -> None:
    pytest.importorskip("pandas")
    image = np.zeros((100, 200, 3), np.uint8)
    record = vehanchor.measure_distance(image, [(10, 20), (40, 60)], gsd_m_per_px=0.1)
    nested = {"scale_gsd_m_per_px", "estimate_gsd_m_per_px", "estimate_tilt_deg", "n_path"}
    assert nested < set(record.to_frame().columns)


@pytest.mark.parametrize(
    "kind", [GsdEstimate, vehanchor.AreaMeasurement, vehanchor.DistanceMeasurement]
)
def test_a_record_of_another_schema_version_is_refused(kind: type[BaseModel]) -> None:
    assert kind.model_fields["schema_version"].default == SCHEMA_VERSION
    with pytest.raises(ValidationError, match="schema_version"):
        kind.model_validate({"schema_version": SCHEMA_VERSION + 1})


def test_a_notebook_shows_texts_of_a_record_escaped(estimate: GsdEstimate) -> None:
    attack = "<img src=x onerror=alert(1)>"
    notice = Notice(code="x", message=attack)
    record = estimate.model_copy(update={"model": attack, "warnings": (notice,)})
    html = record._repr_html_()
    assert f"{record.gsd_m_per_px:.4g}" in html
    assert "<img" not in html
    assert html.count("&lt;img") == 2


# --- Geometries


def _ring(*corners: tuple[float, float]) -> OutlineRing:
    points = [ImagePoint(x_px=x, y_px=y) for x, y in corners]
    return OutlineRing(points=tuple(points))


def test_an_outline_is_a_geometry_with_closed_rings() -> None:
    exterior_ring = _ring((0, 0), (9, 0), (9, 9), (0, 9))
    hole_ring = _ring((2, 2), (4, 2), (4, 4))
    piece = OutlinePolygon(exterior=exterior_ring, holes=(hole_ring,))
    geometry = AreaMeasurement.model_construct(outline=(piece,)).__geo_interface__
    assert geometry["type"] == "MultiPolygon"
    ((exterior, hole),) = geometry["coordinates"]
    assert exterior[0] == exterior[-1] == [0, 0]
    assert hole == [[2, 2], [4, 2], [4, 4], [2, 2]]


def test_a_distance_is_a_line_for_shapely() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    record = vehanchor.measure_distance(image, [(10, 20), (40, 60)], gsd_m_per_px=0.1)
    assert record.__geo_interface__ == {"type": "LineString", "coordinates": [[10, 20], [40, 60]]}
    shapely = pytest.importorskip("shapely.geometry")
    assert shapely.shape(record).length == pytest.approx(50)


class _Geometry:
    """A geometry of shapely, as far as it is used."""

    bounds = (75.0, 55.0, 225.0, 145.0)
    coords = ((10.0, 20.0), (40.0, 60.0))


class _Detections:
    """Detections of supervision, as far as they are used."""

    def __init__(self, n: int) -> None:
        self.xyxy = np.repeat([[75, 55, 225, 145]], n, axis=0).astype(np.float32)


CORNERS = read_prompt((75, 55, 225, 145), None)
PATH = read_path([(10, 20), (40, 60)])


@pytest.mark.parametrize("box", [_Geometry(), _Detections(1)])
def test_a_box_is_read_from_objects_of_other_libraries(box: Any) -> None:
    assert read_prompt(box, None) == CORNERS


def test_a_path_is_read_from_a_geometry() -> None:
    assert read_path(_Geometry()) == PATH  # type: ignore[arg-type]


def test_detections_of_several_objects_are_not_a_box() -> None:
    with pytest.raises(PromptError, match=r"of 2 objects: give one"):
        read_prompt(_Detections(2), None)  # type: ignore[arg-type]


def test_geometries_of_shapely_are_read() -> None:
    shapely = pytest.importorskip("shapely.geometry")
    assert read_prompt(shapely.box(75, 55, 225, 145), None) == CORNERS
    assert read_path(shapely.LineString([(10, 20), (40, 60)])) == PATH


def test_a_polygon_is_not_a_path() -> None:
    shapely = pytest.importorskip("shapely.geometry")
    with pytest.raises(PromptError, match="give a line"):
        read_path(shapely.box(0, 0, 1, 1))


# --- Texts


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.12, "0.120"),
        (12.0, "12.0"),
        (300.0, "300"),
        (9.996, "10.0"),
        (1234.5, "1234"),
        (0.00012, "0.000120"),
        (0, "0"),
    ],
)
def test_significant_digits_keep_zeros_at_the_end(value: float, text: str) -> None:
    assert significant(value) == text


@given(st.floats(1e-6, 1e9), st.integers(1, 6))
def test_significant_digits_are_right_without_an_exponent(value: float, digits: int) -> None:
    assume(math.isfinite(value))
    text = significant(value, digits)
    assert "e" not in text
    assert len(text.replace(".", "").lstrip("0")) >= digits
    assert float(text) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits))


def test_an_interval_follows_its_value() -> None:
    text = with_interval(0.12, 0.1, high=0.15, unit="m/px")
    assert text == "0.1200 m/px  (95 %: 0.1000 to 0.1500)"
    assert with_interval(12, None, high=15, unit="m") == "12.00 m"


def test_the_interval_of_a_scale_states_its_premise() -> None:
    """Command line, overlay and plot show this text."""
    text = with_interval(0.12, 0.1, high=0.15, unit="m/px", premise=INTERVAL_PREMISE)
    assert text.endswith("(95 %: 0.1000 to 0.1500 if at least one ruler is right)")


@pytest.mark.parametrize("record", [GsdEstimate, FrameScale, KnownScale, FlightPhotograph])
def test_records_describe_the_interval_with_its_premise(record: type[Record]) -> None:
    for end in ("low", "high"):
        description = record.model_fields[f"gsd_ci95_{end}_m_per_px"].description or ""
        assert "95 % interval if at least one ruler is right" in description


# --- Stored records


@pytest.mark.parametrize("scene", CASES)
def test_records_stay_as_they_are_stored(scene: Path) -> None:
    name = scene.relative_to(ROOT).as_posix()
    stored = json.loads(KEPT.read_text(encoding="utf-8"))
    records = renewed(records_of(scene), stored[name])
    assert records == stored[name]
    # Dictionaries of another order are equal, too.
    assert json.dumps(records) == json.dumps(stored[name])


def test_renewed_records_keep_numbers_that_differ_by_the_processor() -> None:
    stored = {"a": [1.0, 2.0], "mask_area_px": 40, "message": "1.00 m", "n": 3}
    value = {"a": [1.0 + 1e-9, 2.5], "mask_area_px": 42, "message": "1.01 m", "n": 4}
    assert renewed(value, stored) == {**stored, "a": [1.0, 2.5], "n": 4}


def test_renewed_records_have_changed_words_of_messages() -> None:
    assert renewed({"message": "9 m long"}, {"message": "8 m wide"}) == {"message": "9 m long"}


def test_renewed_records_have_new_and_no_former_fields() -> None:
    assert renewed({"b": 1.0, "c": [1, 2]}, {"a": 1.0, "c": [1]}) == {"b": 1.0, "c": [1, 2]}
