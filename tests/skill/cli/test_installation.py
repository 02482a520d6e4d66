"""``vehanchor models --check``: what is installed, and whether the bundled picture is measured rightly."""

from __future__ import annotations

import importlib.metadata
import re

import pytest
from typer.testing import CliRunner

from vehanchor.cli import installation
from vehanchor.cli.app import app
from vehanchor.cli.installation import PictureCheck


def run() -> tuple[int, str]:
    result = CliRunner().invoke(app, ["models", "--check"])
    return result.exit_code, result.stdout


def test_the_bundled_picture_has_the_scale_that_is_known() -> None:
    code, out = run()
    assert code == 0, out
    assert re.search(r"check\s+passed", out)
    assert re.search(r"vehanchor\s+0\.", out)
    assert "CPUExecutionProvider" in out


@pytest.mark.parametrize(("gsd", "status"), [(None, "no_scale"), (0.15, "low_confidence"), (0.2, "ok")])
def test_a_scale_that_is_wrong_or_not_usable_fails(
    gsd: float | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "check_picture", lambda engine: PictureCheck(gsd, status, 1.0))
    code, out = run()
    assert code == 1
    assert "FAILED" in out


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = importlib.metadata.version

    def version(name: str) -> str:
        if name == "rasterio":
            raise importlib.metadata.PackageNotFoundError(name)
        return original(name)

    monkeypatch.setattr(installation, "version", version)
    monkeypatch.setattr(installation, "check_picture", lambda engine: PictureCheck(0.15, "ok", 1.0))
    assert re.search(r"rasterio\s+missing: pip install 'vehanchor\[geo\]'", run()[1])


def test_without_an_option_the_help_is_shown() -> None:
    assert "--check" in CliRunner().invoke(app, ["models"]).output
