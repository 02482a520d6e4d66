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
from tests.records import CASES, KEPT, records_of
from vehanchor.batch.row import ALL_COLUMNS
from vehanchor.errors import MissingExtraError, PromptError
from vehanchor.measure.distance import read_path
from vehanchor.records import (
    SCHEMA_VERSION,
    AreaMeasurement,
    EstimateDetails,
    GsdEstimate,
    ImagePoint,
    Notice,
    OutlinePolygon,
    OutlineRing,
)
from vehanchor.records.flat import flat_columns, flat_row
from vehanchor.records.text import significant, with_interval
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


def test_a_record_shows_twenty_fields_and_has_the_others_in_its_details() -> None:
    assert len(GsdEstimate.model_fields) <= 20
    assert not set(GsdEstimate.model_fields) & set(EstimateDetails.model_fields)


def test_a_table_needs_pandas_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        _estimate().to_frame()


def test_columns_and_their_types_are_the_same_for_every_record_of_a_type() -> None:
    pytest.importorskip("pandas")
    full = _estimate()
    nothing = make_analysis(np.zeros((0, 5)), 600, 300).estimate
    assert (full.gsd_m_per_px is None, nothing.gsd_m_per_px is None) == (False, True)
    assert list(flat_row(full)) == list(flat_row(nothing)) == list(flat_columns(GsdEstimate))
    assert (len(full.to_frame()), full.to_frame().gsd_m_per_px[0]) == (1, full.gsd_m_per_px)
    assert full.to_frame().dtypes.equals(nothing.to_frame().dtypes)
    assert full.to_frame()["ruler_vehicles_gsd_m_per_px"][0] == full.rulers[0].gsd_m_per_px
    image = np.zeros((100, 200, 3), np.uint8)
    given = vehanchor.measure_distance(image, [(10, 20), (40, 60)], gsd_m_per_px=0.1)
    columns = set(given.to_frame().columns)
    assert {"scale_gsd_m_per_px", "estimate_gsd_m_per_px", "estimate_tilt_deg", "n_path"} < columns


def test_a_table_of_a_batch_has_the_columns_of_a_data_frame() -> None:
    assert set(ALL_COLUMNS) - {"file", "error_code", "error"} == set(
        flat_columns(GsdEstimate, without=("frame",))
    )


@pytest.mark.parametrize(
    "kind", [GsdEstimate, vehanchor.AreaMeasurement, vehanchor.DistanceMeasurement]
)
def test_a_record_of_another_schema_version_is_refused(kind: type[BaseModel]) -> None:
    assert kind.model_fields["schema_version"].default == SCHEMA_VERSION
    with pytest.raises(ValidationError, match="schema_version"):
        kind.model_validate({"schema_version": SCHEMA_VERSION + 1})


def test_a_notebook_shows_a_record_without_trusting_its_texts() -> None:
    attack = "<img src=x onerror=alert(1)>"
    record = _estimate().model_copy(
        update={"model": attack, "warnings": (Notice(code="x", message=attack),)}
    )
    shown = record._repr_html_()
    assert f"{record.gsd_m_per_px:.4g}" in shown
    assert "<img" not in shown
    assert shown.count("&lt;img") == 2


def test_an_outline_is_a_geometry_with_closed_rings_and_holes() -> None:
    def ring(*corners: tuple[float, float]) -> OutlineRing:
        return OutlineRing(points=tuple(ImagePoint(x_px=x, y_px=y) for x, y in corners))

    piece = OutlinePolygon(
        exterior=ring((0, 0), (9, 0), (9, 9), (0, 9)), holes=(ring((2, 2), (4, 2), (4, 4)),)
    )
    geometry = AreaMeasurement.model_construct(outline=(piece,)).__geo_interface__
    assert geometry["type"] == "MultiPolygon"
    ((exterior, hole),) = geometry["coordinates"]
    assert exterior[0] == exterior[-1] == [0, 0]
    assert hole == [[2, 2], [4, 2], [4, 4], [2, 2]]


def test_a_distance_is_a_line_that_shapely_takes() -> None:
    record = vehanchor.measure_distance(
        np.zeros((100, 200, 3), np.uint8), [(10, 20), (40, 60)], gsd_m_per_px=0.1
    )
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
def test_zeros_are_kept_and_whole_digits_too(value: float, text: str) -> None:
    assert significant(value) == text


@given(st.floats(1e-6, 1e9), st.integers(1, 6))
def test_it_is_the_number_within_half_a_digit_and_has_no_exponent(
    value: float, digits: int
) -> None:
    assume(math.isfinite(value))
    text = significant(value, digits)
    assert "e" not in text
    assert len(text.replace(".", "").lstrip("0")) >= digits
    assert float(text) == pytest.approx(value, rel=0.51 * 10 ** (1 - digits))


def test_an_interval_follows_its_value() -> None:
    assert (
        with_interval(0.12, 0.1, high=0.15, unit="m/px") == "0.1200 m/px  (95 %: 0.1000 to 0.1500)"
    )
    assert with_interval(12, None, high=15, unit="m") == "12.00 m"


_ROUNDING = 1e-3  # processors round a network's sums differently


def _assert_like(found: Any, kept: Any, where: str) -> None:
    if isinstance(kept, dict):
        assert list(found) == list(kept), where
        for key in kept:
            _assert_like(found[key], kept[key], f"{where}.{key}")
    elif isinstance(kept, list):
        assert len(found) == len(kept), where
        for number, pair in enumerate(zip(found, kept, strict=True)):
            _assert_like(*pair, f"{where}[{number}]")
    elif isinstance(kept, float):
        assert found == pytest.approx(kept, rel=_ROUNDING, abs=_ROUNDING), where
    elif where.endswith("mask_area_px"):
        assert found == pytest.approx(kept, rel=_ROUNDING, abs=3), where
    elif not where.endswith("message"):  # its numbers are rounded, which a processor may tip over
        assert found == kept, where


@pytest.mark.parametrize("scene", CASES)
def test_records_stay_as_they_were_kept(scene: Path) -> None:
    name = scene.relative_to(ROOT).as_posix()
    _assert_like(records_of(scene), json.loads(KEPT.read_text(encoding="utf-8"))[name], name)
