"""Every code block of the README and the documentation runs, in order, in a folder as a user would have it."""

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
from typer.testing import CliRunner

from tests.conftest import ROOT
from tests.docs.documents import DOCUMENTS, REASONS, blocks
from tests.flight.reconstruction.flights import Pose, write_opensfm
from vehanchor.cli.app import app

_WITH_CODE = [
    document for document in DOCUMENTS if any(block.reason is None for block in blocks(document))
]


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Our examples alone, as a clone has them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    return tmp_path


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Our examples, a photograph of known scale, a flight, a survey, and a model at 92 % of its size."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shutil.copy(ROOT / "examples/car_park.jpg", tmp_path / "photo.jpg")
    (tmp_path / "home.csv").write_text("file,gsd_m_per_px\nphoto.jpg,0.12\n")
    (tmp_path / "flight").mkdir()
    for name in ("safe.jpg", "no_cars.jpg"):
        shutil.copy(ROOT / "examples/scenes" / name, tmp_path / "flight")
    (tmp_path / "survey").mkdir()
    pixels = cv2.imread(str(tmp_path / "photo.jpg"))
    assert pixels is not None
    height, width, bands = pixels.shape
    shape = {"width": width, "height": height, "count": bands, "dtype": "uint8"}
    # the scale that examples/car_park.json tells
    place = Affine(0.12, 0, 500_000, 0, -0.12, 5_300_000)
    with rasterio.open(
        tmp_path / "survey/site.tif", "w", "GTiff", crs="EPSG:32632", transform=place, **shape
    ) as file:
        file.write(pixels[:, :, ::-1].transpose(2, 0, 1))
    seen = np.asarray(pixels[:, :, ::-1], dtype=np.uint8)
    pose = Pose(width * 0.06, height * 0.06, 120)  # 0.12 m/px
    write_opensfm(
        tmp_path / "project", [pose.photograph(seen, 0.12)], poses=[pose], metres_per_unit=1 / 0.92
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _run(command: str, document: Path) -> None:
    program, *arguments = shlex.split(command)
    if program == "vehanchor":
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, f"{command}: {result.output}"
    elif program == "python":
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            [sys.executable, *arguments],
            env={
                **os.environ,
                "PATH": path,
                "PYTHONPATH": os.pathsep.join([*sys.path, os.fspath(ROOT)]),
            },
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
    else:
        assert document.name == "README.md", (
            f"nobody here runs {command!r}: give the block a title that says why"
        )
        # tests/packaging/test_readme.py
        assert command == "pytest" or command.startswith("pip install "), command


@pytest.mark.slow
@pytest.mark.parametrize(
    "document", _WITH_CODE, ids=[path.relative_to(ROOT).as_posix() for path in _WITH_CODE]
)
def test_it_runs(document: Path, request: pytest.FixtureRequest) -> None:
    request.getfixturevalue("clone" if document.name == "README.md" else "folder")
    for block in blocks(document):
        # what something printed, and settings
        if block.reason is not None or block.language in {"text", "toml"}:
            continue
        if block.language == "python":
            exec(compile(block.text, f"{document.name}: {block.text.splitlines()[0]}", "exec"), {})
        else:
            assert block.language == "console", f"no one runs {block.language}"
            assert block.commands
            for command in block.commands:
                _run(command, document)


@pytest.mark.parametrize(
    "document", DOCUMENTS, ids=[path.relative_to(ROOT).as_posix() for path in DOCUMENTS]
)
def test_a_block_that_is_not_run_says_why(document: Path) -> None:
    assert {block.reason for block in blocks(document)} - {None} <= REASONS


def test_most_blocks_do_run() -> None:
    everything = [block for document in DOCUMENTS for block in blocks(document)]
    assert sum(block.reason is None for block in everything) > 0.5 * len(everything)
