from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.flight.reconstruction.flights import Pose, write_opensfm
from tests.models import write_detector
from vehanchor.cli import app as cli
from vehanchor_flight.reconstruction.files import read_model

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result

LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor flight rescale`` in a folder with a model at 92 % of its size."""
    cars = np.column_stack([[(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)], LENGTHS, np.arange(12) * 0.3])
    poses = [Pose(80, 80, 70), Pose(110, 85, 70, 8, 100), Pose(100, 90, 75)]
    write_opensfm(tmp_path / "project", [pose.painted(cars) for pose in poses], poses, 1 / 0.92)
    write_detector(tmp_path / "detector.onnx")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")

    def invoke(*arguments: object) -> Result:
        given = [*map(str, arguments), "--detector", "detector.onnx", "--reference-length", "4.8"]
        return CliRunner().invoke(cli.app, ["flight", "rescale", *given])

    return invoke


def test_the_verdict_is_told_and_the_files_are_in_metres(run: Any, tmp_path: Path) -> None:
    done = run("project", "--project", "metric", "--geo", "geo.txt", "--out", "scale.json")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "scale.json").read_text())["status"] == "ok"
    assert "One unit of the model is 1.08" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= 80
    heights = [shot.centre[2] for shot in read_model(tmp_path / "metric").shots]
    assert heights == pytest.approx([70, 70, 75], rel=0.015)
    assert len((tmp_path / "geo.txt").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["nothing.json"], "reconstruction_unusable"),
        (["."], "reconstruction_unusable"),
        (["project", "--images", "."], "reconstruction_unusable"),
        (["project", "--geo", "nowhere/a.txt"], "output_unwritable"),
        (["project", "--project", "project"], "output_unwritable"),
    ],
)
def test_what_cannot_be_done_is_told_with_its_remedy(run: Any, arguments: list[str], code: str) -> None:
    done = run(*arguments)
    assert done.exit_code == 2, done.output
    assert f"error[{code}]" in done.stderr


def test_nothing_is_written_without_a_usable_size(run: Any, tmp_path: Path) -> None:
    pose = Pose(80, 80, 70)
    write_opensfm(tmp_path / "bare", [pose.painted(np.zeros((0, 4)))], [pose], 1.0)
    done = run("bare", "--geo", "geo.txt")
    assert done.exit_code == 3
    assert "no file in metres was written" in done.stderr
    assert not (tmp_path / "geo.txt").exists()
