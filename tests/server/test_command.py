from __future__ import annotations

import re
import typing
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from vehanchor_server.command import serve
from vehanchor_server.schemas import schema_files
from vehanchor_server.settings import Settings, variable_name

SAMPLES: dict[str, Any] = {
    "image_hosts": ("a.test", "b.test:8443"),
    "segmenter": (Path("e.onnx"), Path("d.onnx")),
    "providers": ("cuda", "cpu"),
    "isolation": "unconfined",
    "public_urls": ("https://a.test/mcp",),
    "oidc": ("https://a.test", "x"),
}


@pytest.fixture(scope="module")
def app() -> typer.Typer:
    made = typer.Typer()
    made.command()(serve)
    made.callback()(lambda: None)
    return made


@pytest.fixture(scope="module")
def shown(app: typer.Typer) -> list[str]:
    """The lines of ``serve --help``."""
    result = CliRunner().invoke(app, ["serve", "--help"], env={"COLUMNS": "200"})
    return re.sub(r"\x1b\[[0-9;]*m", "", result.output).splitlines()


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[Settings]:
    """The settings of servers that would have been started."""
    settings: list[Settings] = []
    monkeypatch.setattr("vehanchor_server.transport.stdio.serve_stdio", settings.append)
    monkeypatch.setattr("vehanchor_server.transport.http.serve_http", settings.append)
    return settings


def sample(field: Field[Any], folder: Path) -> Any:
    """A value that is not the default."""
    if field.name in SAMPLES:
        return SAMPLES[field.name]
    if field.name == "roots":
        return (folder,)
    kind = typing.get_type_hints(Settings)[field.name]
    bare = next(option for option in (*typing.get_args(kind), kind) if isinstance(option, type))
    return bare(7 if bare in (int, float) else "name")


@pytest.mark.parametrize("field", fields(Settings), ids=lambda field: str(field.name))
def test_every_setting_is_in_the_help_with_its_words_and_its_default(shown: list[str], field: Field[Any]) -> None:
    (line,) = [line for line in shown if f"\N{BOX DRAWINGS LIGHT VERTICAL} {flag_of(field)} " in line]
    words = field.metadata["words"]
    text = words.help.removesuffix(".")
    assert text[:60] in line
    if field.default or words.if_unset:
        default = words.if_unset or str(field.default).removesuffix(".0")
        assert f"[{default}]." in "\n".join(shown[shown.index(line) : shown.index(line) + 3])


@pytest.mark.parametrize("field", fields(Settings), ids=lambda field: str(field.name))
def test_every_setting_is_a_flag_and_a_variable(
    app: typer.Typer, served: list[Settings], tmp_path: Path, field: Field[Any]
) -> None:
    value = sample(field, tmp_path)
    assert value != field.default
    flag = flag_of(field)
    words = [flag] if value is True else [word for each in values(field, value) for word in (flag, *each)]
    assert CliRunner().invoke(app, ["serve", *words]).exit_code == 0
    separator = field.metadata["words"].separator
    text = separator.join(map(str, value)) if isinstance(value, tuple) else str(value)
    assert CliRunner().invoke(app, ["serve"], env={variable_name(field.name): text}).exit_code == 0
    expected = Settings(**{field.name: value})
    assert served == [expected, expected]


def flag_of(field: Field[Any]) -> str:
    return f"--{field.metadata['words'].flag or field.name.replace('_', '-')}"


def values(field: Field[Any], value: Any) -> list[list[str]]:
    """The words that follow the flag, each time it is given."""
    if field.name in ("segmenter", "oidc"):
        return [[str(part) for part in value]]
    return [[str(part)] for part in value] if isinstance(value, tuple) else [[str(value)]]


def test_flags_come_before_variables(app: typer.Typer, served: list[Settings]) -> None:
    arguments = ["serve", "--http", "--port", "9001", "--threads", "2"]
    environ = {"VEHANCHOR_DEADLINE_S": "9", "VEHANCHOR_THREADS": "7"}
    assert CliRunner().invoke(app, arguments, env=environ).exit_code == 0
    assert served == [Settings(port=9001, threads=2, deadline_s=9.0)]


def test_a_wrong_setting_is_a_line_on_stderr_and_status_2(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, ["serve", "--deadline-s", "-1"])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr == "error[invalid_settings]: deadline_s is -1.0: use a finite number > 0\n"


def test_a_public_address_without_authentication_is_refused(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, ["serve", "--http", "--host", "0.0.0.0"])
    assert result.exit_code == 2
    assert "refusing to listen on 0.0.0.0 without authentication" in result.stderr


def test_schemas_are_written_and_named(app: typer.Typer, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["serve", "--schemas", str(tmp_path)])
    assert result.exit_code == 0
    assert {Path(line).name for line in result.stdout.splitlines()} == set(schema_files())
