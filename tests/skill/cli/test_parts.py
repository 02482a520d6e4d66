"""Parts of the command line: check of the installation, names below a common folder."""

from __future__ import annotations

import importlib.metadata
import re
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from vehanchor.cli import installation
from vehanchor.cli.app import app
from vehanchor.cli.terminal import under_one_folder


def _checked() -> tuple[int, str]:
    result = CliRunner().invoke(app, ["models", "--check"])
    return result.exit_code, result.stdout


def _record(gsd: float | None, status: str) -> SimpleNamespace:
    return SimpleNamespace(
        gsd_m_per_px=gsd, gsd_ci95_low_m_per_px=None, gsd_ci95_high_m_per_px=None, status=status
    )


def test_the_bundled_picture_passes_the_check() -> None:
    code, out = _checked()
    assert code == 0, out
    assert re.search(r"check\s+passed", out)
    assert re.search(r"vehanchor\s+0\.", out)
    assert "CPUExecutionProvider" in out


@pytest.mark.parametrize(
    ("gsd", "status"), [(None, "no_scale"), (0.15, "low_confidence"), (0.2, "ok")]
)
def test_a_wrong_or_unusable_scale_fails_the_check(
    gsd: float | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "check_picture", lambda engine: _record(gsd, status))
    code, out = _checked()
    assert code == 1
    assert "FAILED" in out


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = importlib.metadata.version

    def version(name: str) -> str:
        if name == "rasterio":
            raise importlib.metadata.PackageNotFoundError(name)
        return original(name)

    monkeypatch.setattr(installation, "version", version)
    monkeypatch.setattr(installation, "check_picture", lambda engine: _record(0.15, "ok"))
    _, out = _checked()
    assert re.search(r"rasterio\s+missing: pip install '\.\[geo\]'", out)


@pytest.mark.parametrize(
    ("names", "folder", "short"),
    [
        (["/a/b/c.jpg", "/a/b/d/e.jpg"], "/a/b", ["c.jpg", "d/e.jpg"]),
        (["flight/a.jpg", "flight/b.jpg"], "flight", ["a.jpg", "b.jpg"]),
        (["/a/b.jpg", "c.jpg"], "", ["/a/b.jpg", "c.jpg"]),
        (["#1", "frame at 3 s"], "", ["#1", "frame at 3 s"]),
    ],
)
def test_names_are_shown_relative_to_their_common_folder(
    names: list[str], folder: str, short: list[str]
) -> None:
    assert under_one_folder(names) == (folder, short)
