"""Test measurements with the scale that a georeferenced file states."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rasterio.transform import Affine

import vehanchor
from tests.models import pool_among_cars, write_detector
from tests.skill.imagery.files import geotiff
from vehanchor.measure.file_scale import compare
from vehanchor.options.rulers import StatedScale
from vehanchor.records.contradiction import contradiction_text
from vehanchor.records.text import file_scale_text
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.density import lognormal
from vehanchor.scale.posterior import Witness, answer

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.records import DistanceMeasurement

# The cars show 0.168 m/px.
FILE_GSD = 0.17
STALE_GSD = 0.09
LINE = [(100.0, 100.0), (400.0, 100.0)]


def _write(
    path: Path,
    across_m: float = FILE_GSD,
    down_m: float = FILE_GSD,
    rgb: NDArray[np.uint8] | None = None,
) -> Path:
    transform = Affine(across_m, 0, 500_000, 0, -down_m, 5_000_000)
    return geotiff(path, pool_among_cars() if rgb is None else rgb, transform=transform)


@pytest.fixture(scope="module")
def orthophoto(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GeoTIFF whose scale is that of its cars."""
    return _write(tmp_path_factory.mktemp("file_scale") / "ortho.tif")


@pytest.fixture(scope="module")
def stale(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GeoTIFF with the georeference of a picture that was larger."""
    folder = tmp_path_factory.mktemp("stale")
    return _write(folder / "copy.tif", across_m=STALE_GSD, down_m=STALE_GSD)


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


def test_vehicles_confirm_the_scale_of_the_file(orthophoto: Path, detector: Path) -> None:
    record = _distance(orthophoto, detector)
    alone = vehanchor.estimate_gsd(orthophoto, detector=detector)
    assert record.n_vehicles == alone.n_vehicles
    assert record.scale_confidence is not None
    assert record.scale_confidence > alone.confidence


def test_vehicles_that_contradict_the_file_measure(stale: Path, detector: Path) -> None:
    record = _distance(stale, detector)
    assert record.scale_source == "estimated"
    assert f"own scale is {STALE_GSD} m/px, the rulers give 0.168" in contradiction_text(record)


def test_a_stale_georeference_lowers_the_confidence(stale: Path, detector: Path) -> None:
    record = _distance(stale, detector)
    alone = _distance(stale, detector, file_scale=False)
    assert record.scale_confidence is not None
    assert alone.scale_confidence is not None
    assert record.scale_confidence < alone.scale_confidence
    assert (record.status == "ok") == (record.scale_confidence >= USABLE_CHANCE)


def test_without_vehicles_nothing_contradicts_the_file(detector: Path, tmp_path: Path) -> None:
    plain = np.full((400, 600, 3), 120, np.uint8)
    record = _distance(_write(tmp_path / "plain.tif", rgb=plain), detector)
    assert (record.status, record.scale_source, record.n_vehicles) == ("ok", "file", 0)


@pytest.mark.parametrize("gsd", [0.0011, 60.0])
def test_a_scale_off_the_grid_yields_to_a_usable_estimate(gsd: float) -> None:
    stated = StatedScale(gsd, "measured", tolerance=0.02 * gsd)
    cars = answer([Witness("vehicles", 0.17, right=lognormal(0.17, 0.05))])
    assert not compare(stated, cars).prefers_file
    assert compare(stated, None).prefers_file


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
    plain = np.full((400, 600, 3), 120, np.uint8)
    image = _write(tmp_path / "oblong.tif", across_m=0.2, down_m=0.3, rgb=plain)
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
