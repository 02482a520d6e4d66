"""The recipes for SAHI and supervision work with the real packages."""

from __future__ import annotations

import json
import os
import subprocess
import sysconfig
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.needs import environment

pytestmark = [pytest.mark.frameworks, pytest.mark.timeout(600)]

FOLDER = ROOT / "examples" / "frameworks"
TILE_M = 40


@pytest.fixture(scope="module")
def tiles() -> dict[str, Any]:
    """The example's answer for tiles of 40 m."""
    python = environment(FOLDER / "tiles_in_metres.requirements.txt")
    # The library and its dependencies come from this environment.
    paths = [str(ROOT / "skill"), sysconfig.get_path("purelib")]
    script = FOLDER / "tiles_in_metres.py"
    image = ROOT / "examples" / "scenes" / "safe.jpg"
    done = subprocess.run(
        [str(python), str(script), str(image), str(TILE_M)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def test_a_tile_has_the_size_in_metres(tiles: dict[str, Any]) -> None:
    # The scene has 0.12 m/px.
    assert tiles["tile_px"] == pytest.approx(TILE_M / 0.12, rel=0.1)


def test_both_packages_cut_tiles_of_that_size(tiles: dict[str, Any]) -> None:
    assert tiles["sahi_slices"] == 6
    assert tiles["supervision_tiles"] == 6


def test_masks_of_supervision_have_areas(tiles: dict[str, Any]) -> None:
    assert max(tiles["areas_m2"]) == pytest.approx(TILE_M**2, rel=0.01)
