from __future__ import annotations

import sys

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

import vehanchor
from tests.analyses import make_analysis
from vehanchor.batch.row import ALL_COLUMNS
from vehanchor.errors import MissingExtraError, PromptError
from vehanchor.measure.distance import read_path
from vehanchor.records import SCHEMA_VERSION, GsdEstimate, Notice
from vehanchor.records.flat import flat_columns, flat_row
from vehanchor.records.interop import as_frame, outline_geometry
from vehanchor.segmentation.prompt import read_prompt


def _estimate() -> vehanchor.GsdEstimate:
    boxes = np.array([[50.0 + 60 * k, 50.0, 30.0 + 0.3 * k, 12.0, 0.0] for k in range(6)])
    return make_analysis(boxes, 600, 300).estimate


def test_a_record_is_one_row_of_single_values() -> None:
    record = _estimate().model_copy(
        update={"warnings": (Notice(code="a", message="A."), Notice(code="b", message="B."))}
    )
    row = flat_row(record)
    assert row["gsd_m_per_px"] == record.gsd_m_per_px
    assert record.details.confidence_terms is not None
    assert row["confidence_terms_sample"] == record.details.confidence_terms.sample
    assert row["warning_codes"] == "a b"
    assert not [value for value in row.values() if isinstance(value, dict | list | tuple)]


def test_a_table_needs_pandas_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        _estimate().to_frame()


def test_a_table_has_a_row_a_record() -> None:
    pytest.importorskip("pandas")
    record = _estimate()
    table = record.to_frame()
    assert (len(table), table.gsd_m_per_px[0]) == (1, record.gsd_m_per_px)
    assert len(as_frame([record, record])) == 2


def test_columns_and_their_types_are_the_same_for_every_record_of_a_type() -> None:
    pytest.importorskip("pandas")
    full, nothing = _estimate(), make_analysis(np.zeros((0, 5)), 600, 300).estimate
    assert (full.gsd_m_per_px is None, nothing.gsd_m_per_px is None) == (False, True)
    assert list(flat_row(full)) == list(flat_row(nothing)) == list(flat_columns(GsdEstimate))
    assert full.to_frame().dtypes.equals(nothing.to_frame().dtypes)
    assert full.to_frame()["ruler_vehicles_gsd_m_per_px"][0] == full.rulers[0].gsd_m_per_px
    image = np.zeros((100, 200, 3), np.uint8)
    given = vehanchor.measure_distance(image, [(10, 20), (40, 60)], gsd_m_per_px=0.1)
    columns = set(given.to_frame().columns)
    assert {"scale_gsd_m_per_px", "estimate_gsd_m_per_px", "estimate_tilt_deg", "n_path"} < columns


def test_a_table_of_a_batch_has_the_columns_of_a_data_frame() -> None:
    assert set(ALL_COLUMNS) - {"file", "error_code", "error"} == set(flat_columns(GsdEstimate, without=("frame",)))


@pytest.mark.parametrize("kind", [GsdEstimate, vehanchor.AreaMeasurement, vehanchor.DistanceMeasurement])
def test_a_record_of_another_schema_version_is_refused(kind: type[BaseModel]) -> None:
    assert kind.model_fields["schema_version"].default == SCHEMA_VERSION
    with pytest.raises(ValidationError, match="schema_version"):
        kind.model_validate({"schema_version": SCHEMA_VERSION + 1})


def test_a_notebook_shows_a_record_without_trusting_its_texts() -> None:
    attack = "<img src=x onerror=alert(1)>"
    record = _estimate().model_copy(update={"model": attack, "warnings": (Notice(code="x", message=attack),)})
    shown = record._repr_html_()
    assert f"{record.gsd_m_per_px:.4g}" in shown
    assert "<img" not in shown
    assert shown.count("&lt;img") == 2


def test_an_outline_is_a_geometry_with_closed_rings_and_holes() -> None:
    def ring(*corners: tuple[float, float]) -> dict[str, object]:
        return {"points": [{"x_px": x, "y_px": y} for x, y in corners]}

    piece = {"exterior": ring((0, 0), (9, 0), (9, 9), (0, 9)), "holes": [ring((2, 2), (4, 2), (4, 4))]}
    geometry = outline_geometry([piece])
    assert geometry["type"] == "MultiPolygon"
    ((exterior, hole),) = geometry["coordinates"]
    assert exterior[0] == exterior[-1] == [0, 0]
    assert hole == [[2, 2], [4, 2], [4, 4], [2, 2]]


def test_a_distance_is_a_line_that_shapely_takes() -> None:
    record = vehanchor.measure_distance(np.zeros((100, 200, 3), np.uint8), [(10, 20), (40, 60)], gsd_m_per_px=0.1)
    assert record.__geo_interface__ == {"type": "LineString", "coordinates": [[10, 20], [40, 60]]}
    shapely = pytest.importorskip("shapely.geometry")
    assert shapely.shape(record).length == pytest.approx(50)


class _Geometry:
    """Shapely's, as far as it is used."""

    bounds = (75.0, 55.0, 225.0, 145.0)
    coords = ((10.0, 20.0), (40.0, 60.0))


class _Detections:
    """Supervision's, as far as they are used."""

    def __init__(self, n: int) -> None:
        self.xyxy = np.repeat([[75, 55, 225, 145]], n, axis=0).astype(np.float32)


def test_places_come_from_objects_that_people_have() -> None:
    corners = read_prompt((75, 55, 225, 145), None)
    assert read_prompt(_Geometry(), None) == corners  # type: ignore[arg-type]
    assert read_prompt(_Detections(1), None) == corners  # type: ignore[arg-type]
    assert read_path(_Geometry()) == read_path([(10, 20), (40, 60)])  # type: ignore[arg-type]
    with pytest.raises(PromptError, match=r"of 2 objects: give one"):
        read_prompt(_Detections(2), None)  # type: ignore[arg-type]
    shapely = pytest.importorskip("shapely.geometry")
    with pytest.raises(PromptError, match="give a line"):
        read_path(shapely.box(0, 0, 1, 1))
    assert read_prompt(shapely.box(75, 55, 225, 145), None) == corners
    assert read_path(shapely.LineString([(10, 20), (40, 60)])) == read_path([(10, 20), (40, 60)])
