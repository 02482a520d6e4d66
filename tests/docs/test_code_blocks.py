"""Every code block of README and documentation runs, in order, in a folder like a user's."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from numpy.typing import NDArray
from typer.testing import CliRunner

from tests.conftest import ROOT
from tests.docs.documents import DOCUMENTS, REASONS, blocks
from tests.flight.reconstruction.flights import Pose, write_opensfm
from vehanchor.cli.app import app

# The scale in examples/car_park.json.
GSD = 0.12

_WITH_CODE = [
    document for document in DOCUMENTS if any(block.reason is None for block in blocks(document))
]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with our examples only, as in a clone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "runs").mkdir()
    return tmp_path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a folder with our examples and a user's files.

    The files are a photograph of known scale, a flight, a survey, and a model at 92 % of its size.
    """
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shutil.copy(ROOT / "examples/car_park.jpg", tmp_path / "photo.jpg")
    (tmp_path / "home.csv").write_text(f"file,gsd_m_per_px\nphoto.jpg,{GSD}\n")
    (tmp_path / "flight").mkdir()
    for name in ("safe.jpg", "no_cars.jpg"):
        shutil.copy(ROOT / "examples/scenes" / name, tmp_path / "flight")
    bgr = cv2.imread(str(tmp_path / "photo.jpg"))
    assert bgr is not None
    rgb = np.asarray(bgr[:, :, ::-1], dtype=np.uint8)
    (tmp_path / "survey").mkdir()
    _write_geotiff(tmp_path / "survey/site.tif", rgb)
    _write_model(tmp_path / "project", rgb)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _write_geotiff(path: Path, rgb: NDArray[np.uint8]) -> None:
    height, width, bands = rgb.shape
    shape = {"width": width, "height": height, "count": bands, "dtype": "uint8"}
    transform = Affine(GSD, 0, 500_000, 0, -GSD, 5_300_000)
    with rasterio.open(path, "w", "GTiff", crs="EPSG:32632", transform=transform, **shape) as file:
        file.write(rgb.transpose(2, 0, 1))


def _write_model(folder: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a reconstruction of one photograph, at 92 % of its size."""
    height, width, _ = rgb.shape
    # The camera above the middle of the photograph.
    pose = Pose(width * GSD / 2, height * GSD / 2, 1000 * GSD)
    photograph = pose.photograph(rgb, GSD)
    write_opensfm(folder, [photograph], poses=[pose], metres_per_unit=1 / 0.92)


def _run(command: str, document: Path) -> None:
    program, *arguments = shlex.split(command)
    if program == "vehanchor":
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, f"{command}: {result.output}"
    elif program == "python":
        _run_python(command, arguments)
    else:
        # tests/packaging/test_readme.py runs the other commands of the README.
        assert document.name == "README.md", (
            f"{command!r} is not run here: give the block a title that states why"
        )
        assert command == "pytest" or command.startswith("pip install "), command


def _run_python(command: str, arguments: list[str]) -> None:
    variables = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([*sys.path, os.fspath(ROOT)]),
    }
    done = subprocess.run(
        [sys.executable, *arguments], env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{command}: {done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "document", _WITH_CODE, ids=[path.relative_to(ROOT).as_posix() for path in _WITH_CODE]
)
def test_the_code_of_a_document_runs(document: Path, request: pytest.FixtureRequest) -> None:
    request.getfixturevalue("clone" if document.name == "README.md" else "folder")
    for block in blocks(document):
        # Text is the output of something, and TOML is a setting.
        if block.reason is not None or block.language in {"text", "toml"}:
            continue
        if block.language == "python":
            title = f"{document.name}: {block.text.splitlines()[0]}"
            exec(compile(block.text, title, "exec"), {})
        else:
            assert block.language == "console", f"blocks of {block.language} are not run"
            assert block.commands
            for command in block.commands:
                _run(command, document)


@pytest.mark.parametrize(
    "document", DOCUMENTS, ids=[path.relative_to(ROOT).as_posix() for path in DOCUMENTS]
)
def test_a_block_that_is_not_run_states_why(document: Path) -> None:
    assert {block.reason for block in blocks(document)} - {None} <= REASONS


def test_most_blocks_do_run() -> None:
    reasons = [block.reason for document in DOCUMENTS for block in blocks(document)]
    assert reasons.count(None) > 0.5 * len(reasons)
