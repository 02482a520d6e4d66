"""Test measurements with the scale that a georeferenced file states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from rasterio.transform import Affine

import vehanchor
from tests.models import pool_among_cars, write_detector
from tests.skill.imagery.files import geotiff
from vehanchor.records.text import file_scale_text, file_source_text
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor.records import DistanceMeasurement

# Within the interval of the cars, and not their scale.
FILE_GSD = 0.16
LINE = [(100.0, 100.0), (400.0, 100.0)]


def _write(
    path: Path, across_m: float = FILE_GSD, down_m: float = FILE_GSD, *, n_cars: int = 30
) -> Path:
    transform = Affine(across_m, 0, 500_000, 0, -down_m, 5_000_000)
    return geotiff(path, pool_among_cars(n_cars), transform=transform)


@pytest.fixture(scope="module")
def orthophoto(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GeoTIFF whose scale is not quite that of its cars."""
    return _write(tmp_path_factory.mktemp("file_scale") / "ortho.tif")


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a detector that finds the cars."""
    path: Path = write_detector(tmp_path_factory.mktemp("file_scale_model") / "m.onnx")
    return path


def _distance(image: Path, detector: Path, **keywords: Any) -> DistanceMeasurement:
    return vehanchor.measure_distance(image, LINE, detector=detector, **keywords)


def test_a_distance_takes_the_scale_of_the_file(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector)
    assert record.scale_source == "file"
    assert record.distance_m == pytest.approx(300 * FILE_GSD)


def test_the_scale_of_the_file_is_compared_with_cars(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector)
    assert record.estimate is None
    assert record.n_vehicles == 30
    assert file_source_text(record) == "not contradicted by 30 vehicles"


def test_cars_that_contradict_the_file_measure(detector: Path, tmp_path: Path) -> None:
    image = _write(tmp_path / "stale.tif", across_m=2 * FILE_GSD, down_m=2 * FILE_GSD)
    record = _distance(image, detector)
    assert record.scale_source == "estimated"
    assert record.distance_m == pytest.approx(300 * FILE_GSD, rel=0.1)
    assert record.warnings[0].message.startswith("The file's own scale is 0.32 m/px, the rulers")


def test_a_file_without_cars_has_its_own_scale(detector: Path, tmp_path: Path) -> None:
    record = _distance(_write(tmp_path / "field.tif", n_cars=0), detector)
    assert (record.status, record.scale_source, record.n_vehicles) == ("ok", "file", 0)


def test_a_survey_is_too_large_to_be_compared(
    orthophoto: Path, detector: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor.measure.scale_source._MAX_COMPARED_PX", 1000)
    record = _distance(orthophoto, detector)
    assert (record.scale_source, record.n_vehicles) == ("file", None)


def test_the_scale_of_the_file_has_a_stated_interval(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector)
    assert record.distance_ci95_low_m is not None
    assert record.distance_ci95_low_m <= 300 * FILE_GSD * 0.981


def test_the_scale_of_the_file_is_usable(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector)
    assert record.status == "ok"
    assert record.scale_confidence is not None
    assert USABLE_CHANCE <= record.scale_confidence < 1


@pytest.mark.parametrize(
    "asked",
    [
        {"file_scale": False},
        {"metadata": False},
        {"rulers": ("vehicles", "scene_scale")},
        {"height_m": 100.0, "focal_35mm": 24.0},
        {"gsd_m_per_px": None, "known_lengths": [(100, 100, 400, 100, 45.0)]},
    ],
)
def test_who_asks_for_evidence_gets_the_estimate(
    orthophoto: Path, detector: Path, asked: dict[str, Any]
) -> None:
    record = _distance(orthophoto, detector, **asked)
    assert record.scale_source == "estimated"
    assert record.georeference_gsd_m_per_px == pytest.approx(FILE_GSD)


def test_a_number_of_the_caller_precedes_the_file(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector, gsd_m_per_px=0.1)
    assert (record.scale_source, record.gsd_m_per_px) == ("given", 0.1)


def test_a_file_without_a_scale_is_searched(detector: Path) -> None:
    record = vehanchor.measure_distance(pool_among_cars(), LINE, detector=detector)
    assert record.scale_source == "estimated"


def test_pixels_that_are_not_square_show_both_sides(detector: Path, tmp_path: Path) -> None:
    image = _write(tmp_path / "oblong.tif", across_m=0.2, down_m=0.3, n_cars=0)
    record = _distance(image, detector)
    assert record.distance_m == pytest.approx(300 * 0.2, rel=0.01)
    assert file_scale_text(record) == "0.2000 m/px (0.200 m across, 0.300 m down)"


def test_a_tilted_camera_in_the_file_makes_it_no_map(
    orthophoto: Path, detector: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.raster import Raster

    tilted = CameraMetadata(off_nadir_deg=35.0, focal_35mm=24.0, height_m=100.0)
    monkeypatch.setattr(Raster, "camera", property(lambda _self: tilted, lambda _self, _new: None))
    assert _distance(orthophoto, detector).scale_source == "estimated"


def test_a_camera_that_contradicts_the_file_makes_it_no_map(
    orthophoto: Path, detector: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.raster import Raster

    # 2000 m above ground with this lens are ten times the scale of the file.
    high = CameraMetadata(off_nadir_deg=0.0, focal_35mm=24.0, height_m=2000.0)
    monkeypatch.setattr(Raster, "camera", property(lambda _self: high, lambda _self, _new: None))
    assert _distance(orthophoto, detector).scale_source == "estimated"
