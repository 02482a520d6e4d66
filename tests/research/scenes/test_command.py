from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import pytest
from typer.testing import CliRunner

from research.scenes.__main__ import app


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``python -m research.scenes`` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.delenv("VEHANCHOR_TRACEBACK", raising=False)
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_scene_writes_an_image_and_its_truth(run: Any, tmp_path: Path) -> None:
    out = tmp_path / "scene.png"
    result = run(out, "--gsd", "0.2", "--size", "300", "200", "--seed", "3", "--layout", "parking", "--fleet", "5")
    assert result.exit_code == 0, result.stderr
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.shape == (200, 300, 3)
    printed = "".join(result.stdout.split())
    for path in tmp_path.iterdir():
        assert path.name in printed
    truth = json.loads((tmp_path / "scene.json").read_text())
    assert truth["gsd_m_per_px"] == 0.2
    assert truth["parameters"]["layout"] == "parking"


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["scene.png", "--gsd", "-1"], "invalid_parameter"),
        (["scene.png", "--gsd", "nan"], "invalid_parameter"),
        (["scene.png", "--gsd", "0.2", "--size", "0", "100"], "invalid_parameter"),
        (["scene.gif", "--gsd", "0.2"], "output_unwritable"),
        (["nowhere/scene.png", "--gsd", "0.2"], "output_unwritable"),
    ],
)
def test_scene_refuses_what_has_no_meaning(run: Any, arguments: list[str], code: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith(f"error[{code}]: ")
