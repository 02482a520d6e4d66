from __future__ import annotations

import os
import re
import typing
from dataclasses import Field, fields
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from vehanchor.options.option import Option
from vehanchor_server.command import serve
from vehanchor_server.schemas import schema_files
from vehanchor_server.settings import Settings, SettingsError, variable_name

ISSUER = ("https://a.test", "x")


def test_the_defaults_expose_nothing() -> None:
    settings = Settings()
    assert (settings.roots, settings.image_hosts, settings.host) == ((), (), "127.0.0.1")
    assert settings.deadline_s < 60
    settings.check_exposure()


def test_there_are_at_most_eighteen_settings() -> None:
    assert len(fields(Settings)) <= 18


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"deadline_s": 0}, "deadline_s is 0"),
        ({"max_megapixels": float("nan")}, "max_megapixels"),
        ({"threads": 0}, "threads"),
        ({"isolation": "none"}, "isolation is 'none': use one of confined, unconfined, in-process"),
        ({"roots": (Path("/nowhere"),)}, "existing directory"),
        ({"roots": (Path(__file__),)}, "not a directory"),
        ({"roots": (Path("/"),)}, "whole file system"),
        ({"segmenter": (Path("encoder.onnx"),)}, "segmenter"),
        ({"image_hosts": ("https://a.test",)}, "plain host name"),
        ({"image_hosts": ("*.test",)}, "plain host name"),
        ({"image_hosts": ("a.test:https",)}, "plain host name"),
        ({"image_hosts": ("",)}, "plain host name"),
        ({"oidc": ("https://a.test",)}, "oidc"),
        ({"oidc": ("https://a.test#max-age=0", "x")}, "#max-age=SECONDS may follow"),
        ({"oidc": ("http://a.test", "x")}, "the issuer's https:// URL"),
        ({"oidc": ISSUER, "token_file": Path("t")}, "exclude each other"),
        (
            {"oidc": ISSUER, "host": "0.0.0.0"},
            r"^listening on 0\.0\.0\.0 with an issuer: give --public-url",
        ),
        *(
            (
                {"public_urls": (url,)},
                r"^public_url is .*: write all of it, as in https://example\.org/mcp",
            )
            for url in (
                "example.org",
                "example.org/mcp",
                "ftp://example.org/mcp",
                "https://",
                "http://[::1/mcp",
            )
        ),
    ],
)
def test_options_without_meaning_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        Settings(**options)


def test_memory_limits_follow_the_pixels() -> None:
    small = Settings(max_megapixels=25)
    large = Settings(max_megapixels=500)
    assert (
        large.image_limits.max_decoded_bytes
        == 20 * small.image_limits.max_decoded_bytes
        == 5_500_000_000
    )
    for settings in (small, large):
        assert settings.max_worker_bytes > 2 * settings.image_limits.max_decoded_bytes


@pytest.mark.promise("tokens")
@pytest.mark.parametrize(
    ("options", "allowed"),
    [
        ({"host": "127.0.0.1"}, True),
        ({"host": "localhost"}, True),
        ({"host": "::1"}, True),
        ({"host": "0.0.0.0"}, False),
        ({"host": "::"}, False),
        ({"host": "192.168.1.5"}, False),
        ({"host": "0.0.0.0", "insecure": True}, True),
        ({"host": "0.0.0.0", "token_file": Path("tokens")}, True),
        ({"host": "0.0.0.0", "oidc": ISSUER, "public_urls": ("https://b.test/mcp",)}, True),
    ],
)
def test_a_public_address_needs_authentication(options: dict[str, Any], allowed: bool) -> None:
    settings = Settings(**options)
    if allowed:
        settings.check_exposure()
    else:
        with pytest.raises(SettingsError, match="refusing to listen"):
            settings.check_exposure()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("PORT", "http"),
        ("DEADLINE_S", "soon"),
        ("INSECURE", "maybe"),
        ("OIDC", "https://a.test"),
        ("ISOLATION", "x"),
    ],
)
def test_a_variable_that_cannot_be_read_is_named(name: str, text: str) -> None:
    with pytest.raises(SettingsError, match=f"VEHANCHOR_{name} is '{text}'"):
        Settings.from_environment({f"VEHANCHOR_{name}": text})


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


def test_the_help_has_every_setting_with_its_default(shown: list[str]) -> None:
    for field in fields(Settings):
        (line,) = [
            line for line in shown if f"\N{BOX DRAWINGS LIGHT VERTICAL} {flag_of(field)} " in line
        ]
        assert option_of(field).help[:60] in line
        if field.default:
            default = str(field.default).removesuffix(".0")
            assert f"[default: ({default})]" in "\n".join(
                shown[shown.index(line) : shown.index(line) + 3]
            )


@pytest.mark.parametrize("field", fields(Settings), ids=lambda field: str(field.name))
def test_every_setting_can_be_a_flag_or_a_variable(
    app: typer.Typer, served: list[Settings], tmp_path: Path, field: Field[Any]
) -> None:
    value = sample(field, tmp_path)
    assert value != field.default
    flag = flag_of(field)
    words = (
        [flag]
        if value is True
        else [word for each in values(field, value) for word in (flag, *each)]
    )
    assert CliRunner().invoke(app, ["serve", *words]).exit_code == 0
    separator = os.pathsep if field.name in ("roots", "segmenter") else ","
    text = separator.join(map(str, value)) if isinstance(value, tuple) else str(value)
    assert CliRunner().invoke(app, ["serve"], env={variable_name(field.name): text}).exit_code == 0
    expected = Settings(**{field.name: value})
    assert served == [expected, expected]


def option_of(field: Field[Any]) -> Option:
    (option,) = typing.get_type_hints(Settings, include_extras=True)[field.name].__metadata__[-1:]
    assert isinstance(option, Option)
    return option


def flag_of(field: Field[Any]) -> str:
    return f"--{option_of(field).flag or field.name.replace('_', '-')}"


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


def test_a_wrong_setting_is_one_line_on_stderr(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, ["serve", "--deadline-s", "-1"])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr == "error[invalid_settings]: deadline_s is -1: use a finite number > 0\n"


def test_the_written_schemas_are_named(app: typer.Typer, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["serve", "--schemas", str(tmp_path)])
    assert result.exit_code == 0
    assert {Path(line).name for line in result.stdout.splitlines()} == set(schema_files())
