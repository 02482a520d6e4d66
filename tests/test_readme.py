"""The README's code runs, and its commands do what it says."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.conftest import ROOT
from vehanchor.cli import app

_README = (ROOT / "README.md").read_text(encoding="utf-8")


def _blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", _README, flags=re.DOTALL)


def test_the_python_blocks_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT)
    blocks = _blocks("python")
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    assert "m/px from" in capsys.readouterr().out


def test_the_vehanchor_commands_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    commands = [
        part.strip()
        for block in _blocks("console")
        for line in block.splitlines()
        if line.startswith("$ ")
        for part in line[2:].split("&&")
        if part.strip().startswith("vehanchor ")
    ]
    # Left out: what needs a model of the user's own, and the server, which runs until it is stopped (tests/server).
    theirs = ("yolo11l", "--segmenter", " serve ")
    ours = [command for command in commands if not any(part in command for part in theirs)]
    assert len(ours) >= 2
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    for command in ours:
        result = CliRunner().invoke(app, shlex.split(command)[1:])
        assert result.exit_code == 0, f"{command}: {result.output}"
    assert (tmp_path / "overlay.png").stat().st_size > 10_000
    assert (tmp_path / "scene.png").stat().st_size > 10_000


def test_the_files_it_links_to_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", _README):
        if not target.startswith("http"):
            assert (ROOT / target).exists(), target
