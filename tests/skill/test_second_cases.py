"""Files that people reported, in ``../shared/cases/second``; rendered twins are in other tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import vehanchor
from tests.conftest import ROOT
from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.records import GsdEstimate
from vehanchor_flight.video import sample_video

CASES = ROOT.parent / "shared" / "cases" / "second"

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are absent")


def _record(name: str, **options: Any) -> GsdEstimate:
    return vehanchor.estimate_gsd(CASES / name, **options)


def _codes(record: GsdEstimate) -> set[str]:
    return {notice.code for notice in record.warnings}


def test_two_photographs_side_by_side_are_not_usable() -> None:
    record = _record("c01_two_photographs_2_to_1.jpg")
    assert record.status == "low_confidence"
    assert "several_pictures" in _codes(record)


@pytest.mark.parametrize(
    "options",
    [
        {"rulers": "camera"},
        {"rulers": "camera,height", "height_m": 84, "height_basis": "measured"},
    ],
)
def test_a_sphere_has_no_scale_by_its_camera(options: dict[str, Any]) -> None:
    record = _record("p01_dji_sphere.jpg", **options)
    assert record.status == "no_scale"
    assert {"camera_unusable", "not_perspective"} <= _codes(record)


def test_one_photograph_with_the_same_metadata_has_a_scale() -> None:
    assert _record("p00_control.jpg", rulers="camera").gsd_m_per_px == pytest.approx(0.0877, 0.01)


@pytest.mark.parametrize("name", ["s01_external_mask.tif", "s01_internal_mask.tif"])
def test_a_mask_is_used_inside_and_beside_a_file(name: str) -> None:
    assert _record(name).n_vehicles == 20


def test_a_masked_array_has_its_mask() -> None:
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(CASES / "s01_internal_mask.tif") as dataset:
        masked = dataset.read(masked=True).transpose(1, 2, 0)
    assert np.ma.is_masked(masked)
    assert vehanchor.estimate_gsd(masked).n_vehicles == 20


def test_an_interlaced_film_is_refused() -> None:
    with pytest.raises(ImageDecodeError, match="interlaced"):
        next(sample_video(str(CASES / "v03_interlaced.mp4"), 1.0))


def test_a_progressive_film_is_read() -> None:
    assert list(sample_video(str(CASES / "v00_progressive.mp4"), 1.0))


def test_a_second_page_is_named() -> None:
    assert "pages_unused" in _codes(_record("f02_pages_small_first.tif", rulers="camera"))


def test_the_lens_of_a_heic_is_used() -> None:
    record = _record("h01_iphone.heic", rulers="height", height_m=85, height_basis="measured")
    assert record.status == "ok"


def test_control_points_give_map_coordinates_and_no_scale() -> None:
    with open_raster(CASES / "f04_gcps_only.tif") as raster:
        assert raster.ground is not None
        assert raster.georeference_gsd_m_per_px is None
        transform = raster.ground.transform
    assert (transform.a, transform.c, transform.f) == pytest.approx((0.2, 330000, 4825000))
