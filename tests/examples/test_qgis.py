"""The plugin of examples/qgis in QGIS itself, without a window; QGIS calls the command of this environment."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import rasterio

import vehanchor
from tests.conftest import ROOT
from tests.needs import needed_program

pytestmark = [pytest.mark.qgis, pytest.mark.timeout(900)]


def _python_of_qgis() -> str:
    """The system's Python, which has QGIS where Debian has installed it."""
    for python in ("/usr/bin/python3",):
        if (
            Path(python).exists()
            and subprocess.run([python, "-c", "import qgis.core"], check=False).returncode == 0
        ):
            return python
    return needed_program("qgis", "apt-get install python3-qgis qgis-providers")


def test_the_algorithms_give_the_commands_scale_and_layers_that_qgis_reads(tmp_path: Path) -> None:
    photograph = ROOT / "examples/scenes/safe.jpg"
    empty = ROOT / "examples/scenes/no_cars.jpg"
    command = Path(sys.executable).with_name("vehanchor")
    done = subprocess.run(
        [
            _python_of_qgis(),
            ROOT / "tests/examples/drive_qgis.py",
            ROOT / "examples/qgis",
            photograph,
            empty,
            tmp_path,
        ],
        env={**os.environ, "QT_QPA_PLATFORM": "offscreen", "VEHANCHOR": str(command)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    estimate = vehanchor.estimate_gsd(photograph)
    assert seen["algorithms"] == ["vehanchor:localmetres", "vehanchor:scale"]
    assert seen["scale"]["GSD"] == pytest.approx(estimate.gsd_m_per_px)
    assert (seen["scale"]["STATUS"], seen["scale"]["CONFIDENCE"]) == (
        "ok",
        pytest.approx(estimate.confidence),
    )
    assert seen["boxes"] == [True, estimate.details.n_detections]
    with rasterio.open(seen["raster"]["RASTER"]) as raster:
        assert raster.transform.a == pytest.approx(estimate.gsd_m_per_px)
        assert (raster.width, raster.height) == (estimate.image_width_px, estimate.image_height_px)
    assert seen["by height"]["STATUS"] == "no_scale"  # no focal length is known: nothing is guessed
    assert "the scale is not usable" in seen["refused"]
    assert seen["cancelled"] == "cancelled"
