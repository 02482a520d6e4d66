"""The plugin of examples/qgis runs in QGIS, without a window, with this environment's command."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import rasterio

import vehanchor
from tests.conftest import ROOT
from tests.needs import needed_program

pytestmark = [pytest.mark.qgis, pytest.mark.timeout(900)]


def _python_of_qgis() -> str:
    """Return the system's Python if it has QGIS, where Debian installs it."""
    python = "/usr/bin/python3"
    if Path(python).exists():
        probe = subprocess.run([python, "-c", "import qgis.core"], check=False)
        if probe.returncode == 0:
            return python
    return needed_program("qgis", "apt-get install python3-qgis qgis-providers")


_PHOTOGRAPH = ROOT / "examples/scenes/safe.jpg"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of all algorithms, from one run of QGIS."""
    command = Path(sys.executable).with_name("vehanchor")
    words: list[str | Path] = [
        _python_of_qgis(),
        ROOT / "tests/examples/drive_qgis.py",
        ROOT / "examples/qgis",
        _PHOTOGRAPH,
        ROOT / "examples/scenes/no_cars.jpg",
        tmp_path_factory.mktemp("qgis"),
    ]
    done = subprocess.run(
        words,
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen", "VEHANCHOR": str(command)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    printed: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return printed


@pytest.fixture(scope="module")
def estimate() -> vehanchor.GsdEstimate:
    return vehanchor.estimate_gsd(_PHOTOGRAPH)


def test_the_provider_has_both_algorithms(results: dict[str, Any]) -> None:
    assert results["algorithms"] == ["vehanchor:localmetres", "vehanchor:scale"]


def test_the_scale_is_that_of_the_library(
    results: dict[str, Any], estimate: vehanchor.GsdEstimate
) -> None:
    scale = results["scale"]
    assert scale["GSD"] == pytest.approx(estimate.gsd_m_per_px)
    assert scale["STATUS"] == "ok"
    assert scale["CONFIDENCE"] == pytest.approx(estimate.confidence)


def test_qgis_reads_the_layer_of_vehicles(
    results: dict[str, Any], estimate: vehanchor.GsdEstimate
) -> None:
    assert results["boxes"] == [True, estimate.details.n_detections]


def test_the_raster_has_the_estimated_pixel_size(
    results: dict[str, Any], estimate: vehanchor.GsdEstimate
) -> None:
    with rasterio.open(results["raster"]["RASTER"]) as raster:
        assert raster.transform.a == pytest.approx(estimate.gsd_m_per_px)
        assert (raster.width, raster.height) == (estimate.image_width_px, estimate.image_height_px)


def test_the_raster_is_a_layer_in_metres(
    results: dict[str, Any], estimate: vehanchor.GsdEstimate
) -> None:
    gsd = pytest.approx(estimate.gsd_m_per_px)
    assert results["layer"] == {"unit": "meters", "unit_per_px": gsd}, "as deepness needs it"


def test_a_height_without_a_focal_length_gives_no_scale(results: dict[str, Any]) -> None:
    assert results["by height"]["STATUS"] == "no_scale"


def test_a_raster_without_a_usable_scale_is_refused(results: dict[str, Any]) -> None:
    assert "the scale is not usable" in results["refused"]


def test_an_algorithm_can_be_cancelled(results: dict[str, Any]) -> None:
    assert results["cancelled"] == "cancelled"
