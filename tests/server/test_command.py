from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from vehanchor_server.command import schemas, serve
from vehanchor_server.schemas import schema_files
from vehanchor_server.settings import Settings

SINGULAR = {
    "roots": "root",
    "image_hosts": "image-host",
    "allowed_hosts": "allowed-host",
    "allowed_origins": "allowed-origin",
}


@pytest.fixture
def app() -> typer.Typer:
    made = typer.Typer()
    made.command()(serve)
    made.command()(schemas)
    return made


def test_every_setting_has_a_flag(app: typer.Typer) -> None:
    shown = re.sub(r"\x1b\[[0-9;]*m", "", CliRunner().invoke(app, ["serve", "--help"], env={"COLUMNS": "200"}).output)
    for field in fields(Settings):
        assert f"--{SINGULAR.get(field.name, field.name.replace('_', '-'))}" in shown


def test_flags_become_settings(app: typer.Typer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    served: list[Any] = []
    monkeypatch.setattr("vehanchor_server.transport.stdio.serve_stdio", served.append)
    monkeypatch.setattr(
        "vehanchor_server.transport.http.serve_http", lambda settings, workers: served.extend([settings, workers])
    )
    runner = CliRunner()
    arguments = ["serve", "--root", str(tmp_path), "--threads", "2", "--image-host", "a.test", "--image-host", "b.test"]
    arguments += ["--segmenter", "e.onnx", "d.onnx", "--calibration", "c.json"]
    assert runner.invoke(app, arguments, env={"VEHANCHOR_DEADLINE_S": "9", "VEHANCHOR_THREADS": "7"}).exit_code == 0
    assert served == [
        Settings(
            roots=(tmp_path,),
            threads=2,
            image_hosts=("a.test", "b.test"),
            segmenter=(Path("e.onnx"), Path("d.onnx")),
            calibration=Path("c.json"),
            deadline_s=9.0,
        )
    ]
    served.clear()
    assert runner.invoke(app, ["serve", "--http", "--port", "9001", "--workers", "2"]).exit_code == 0
    assert served == [Settings(port=9001), 2]


def test_a_wrong_setting_is_a_line_on_stderr_and_status_2(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, ["serve", "--deadline-s", "-1"])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr == "error[invalid_settings]: deadline_s is -1.0: use a finite number > 0\n"


def test_schemas_are_written_and_named(app: typer.Typer, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["schemas", str(tmp_path)])
    assert result.exit_code == 0
    assert {Path(line).name for line in result.stdout.splitlines()} == set(schema_files())
