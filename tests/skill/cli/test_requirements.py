"""A failed import names what is installed and what is needed."""

from __future__ import annotations

import sys
from importlib.metadata import version

import pytest
import typer
from typer.testing import CliRunner

from vehanchor.cli.app import app
from vehanchor.cli.requirements import unmet_requirement
from vehanchor.cli.terminal import BAD_INPUT, UNFORESEEN, exit_on_error


def test_an_older_package_is_named_with_its_version() -> None:
    error = ImportError("cannot import name 'MCPServer'", name="mcp.server.mcpserver")
    unmet = unmet_requirement(error)
    assert unmet is not None
    assert unmet.startswith("it needs mcp")
    assert unmet.endswith(f"and mcp {version('mcp')} is installed")


def test_a_module_of_another_name_is_found_by_its_package() -> None:
    unmet = unmet_requirement(ImportError("no cv2", name="cv2"))
    assert unmet is not None
    assert "opencv-python-headless" in unmet


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vehanchor.cli.requirements.requires", lambda _: ["nowhere>=3"])
    unmet = unmet_requirement(ModuleNotFoundError("no nowhere", name="nowhere"))
    assert unmet == "it needs nowhere>=3, and nowhere is not installed"


@pytest.mark.parametrize("name", ["vehanchor.nothing", "unknown", None])
def test_an_import_of_our_own_is_no_requirement(name: str | None) -> None:
    assert unmet_requirement(ImportError("nothing", name=name)) is None


@pytest.mark.parametrize(
    ("name", "status", "code"),
    [
        ("mcp.types", BAD_INPUT, "error[installation_incomplete]"),
        ("vehanchor.nothing", UNFORESEEN, "error[internal_error]"),
    ],
)
def test_the_command_says_whose_fault_it_is(
    name: str, status: int, code: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended, exit_on_error():
        raise ImportError("no such name", name=name)
    assert ended.value.exit_code == status
    assert capsys.readouterr().err.startswith(code)


@pytest.mark.parametrize(
    ("command", "module"),
    [
        (["view", "."], "vehanchor_server.transport.viewer"),
        (["serve", "--skill"], "vehanchor_server.schemas"),
        (["serve"], "vehanchor_server.transport.stdio"),
    ],
    ids=["view", "skill", "serve"],
)
def test_a_command_reports_a_failed_import_in_one_line(
    command: list[str], module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.startswith("error[")
    assert len(result.stderr.splitlines()) == 1
